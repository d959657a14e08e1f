"""Makes the decisions of a black box again, from what they were made from."""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import msgspec

from cbe.camera import CameraModel
from cbe.errors import CameraError, MessageError, RecordingError
from cbe.messages import LaserScan
from cbe.rays import resample
from cbe_runtime import carried
from cbe_runtime.decisionlog import DecisionRecord, Seen, checksum, differing, parse
from cbe_runtime.drive import IMAGE_TYPES
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.observation import Frame, Observation, Scan
from cbe_runtime.view import View

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from cbe.messages import CompressedImage, Image
    from cbe.robot import Robot
    from cbe_runtime.decision import Decision
    from cbe_runtime.follower import Follower
    from cbe_runtime.mcapfile import Recorded

logger = logging.getLogger(__name__)

LOOKAHEAD_NS = 1_000_000_000
"""How much later than the decision that saw it a frame may have reached the recorder."""
KEPT = 64
"""Frames and scans that are looked among."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A recorded decision with what it saw.

    `observation` is None where a frame or scan it saw is not in the recording; `picture` is the
    camera's message behind the frame.
    """

    time_ns: int
    record: DecisionRecord
    observation: Observation | None
    picture: CompressedImage | Image | None


@dataclass(frozen=True, slots=True)
class Retraced:
    """A moment and the decision that came out now; None while the follower's state is unknown."""

    moment: Moment
    made: Decision | None


@dataclass(slots=True)
class Inputs:
    """The last frames and scans by their stamps, and the views that have been made of them."""

    robot: Robot
    _images: OrderedDict[int, list[CompressedImage | Image]] = field(default_factory=OrderedDict)
    _scans: OrderedDict[int, list[LaserScan]] = field(default_factory=OrderedDict)
    _camera: dict[str, Any] | None = None
    _view: View | None = None
    _made: dict[type, tuple[Seen, NDArray[Any], Any]] = field(default_factory=dict)

    def add(self, message: Recorded) -> None:
        """Take in a recorded message; one that does not decode was of no use to anybody."""
        try:
            if message.type_name in IMAGE_TYPES:
                image = IMAGE_TYPES[message.type_name].from_cdr(message.data)
                _keep(self._images, image.stamp_ns, image)
            elif message.type_name == LaserScan.TYPE:
                scan = LaserScan.from_cdr(message.data)
                _keep(self._scans, scan.stamp_ns, scan)
        except MessageError as error:
            logger.debug("%s: %s", message.topic, error)

    def frame(
        self, seen: Seen, camera: dict[str, Any] | None
    ) -> tuple[Frame | None, CompressedImage | Image | None]:
        """The frame that was seen and its message, None where it is not to be found."""
        if seen.crc is None:
            return Frame(None, seen.received_s, seen.stamp_ns), None
        if camera != self._camera or self._view is None:
            self._camera = camera
            self._view = _view(camera)
            self._made.pop(Frame, None)
        found = self._find(Frame, seen, self._images, self._view)
        if found is None:
            return None, None
        return Frame(found[0], seen.received_s, seen.stamp_ns), found[1]

    def scan(self, seen: Seen) -> Scan | None:
        """The scan that was seen, None where it is not to be found."""
        if seen.crc is None:
            return Scan(None, seen.received_s, seen.stamp_ns)
        found = self._find(Scan, seen, self._scans, lambda scan: resample(scan, self.robot))
        return None if found is None else Scan(found[0], seen.received_s, seen.stamp_ns)

    def _find(
        self,
        kind: type,
        seen: Seen,
        among: OrderedDict[int, list[Any]],
        convert: Callable[[Any], NDArray[Any]],
    ) -> tuple[NDArray[Any], Any] | None:
        """What was given to the follower, known by its checksum, and the message behind it."""
        last = self._made.get(kind)
        if last is not None and (last[0].stamp_ns, last[0].crc) == (seen.stamp_ns, seen.crc):
            return last[1], last[2]
        for message in reversed(among.get(seen.stamp_ns, [])):
            try:
                content = convert(message)
            except (MessageError, CameraError):
                continue
            if checksum(content) == seen.crc:
                self._made[kind] = (seen, content, message)
                return content, message
        return None


def moments(messages: Iterable[Recorded], robot: Robot) -> Iterator[Moment]:
    """The recorded decisions in order, each with what it saw.

    Raises:
        RecordingError: a decision's record is of another version or damaged.
    """
    inputs = Inputs(robot)
    waiting: deque[tuple[int, DecisionRecord]] = deque()
    for message in messages:
        while waiting and message.log_time_ns - waiting[0][0] > LOOKAHEAD_NS:
            yield _moment(*waiting.popleft(), inputs)
        if message.type_name == "cbe/Decision":
            try:
                waiting.append((message.log_time_ns, parse(message.data)))
            except msgspec.DecodeError as error:
                raise RecordingError(
                    f"a recorded decision is of another version or damaged ({error}); replay with "
                    "the version that recorded it, or what the camera saw alone, with --footage"
                ) from error
        else:
            inputs.add(message)
    for each in waiting:
        yield _moment(*each, inputs)


def retrace(
    moments: Iterable[Moment], make: Callable[[FollowerConfig], Follower]
) -> Iterator[Retraced]:
    """Make the decisions again, from the first moment on whose state is known.

    That is the first step of a run, or the first of a behavior, when no recurrent state has to
    be known. After a gap, or once decisions differ, it is taken up anew at the next such moment.

    Raises:
        RecordingError: what is recorded of the state is of another version or damaged.
    """
    follower: Follower | None = None
    before: DecisionRecord | None = None
    strayed = False
    for moment in moments:
        record, seen = moment.record, moment.observation
        follows = before is not None and (before.run, before.step + 1) == (record.run, record.step)
        if not follows:
            follower = None
        if record.step == 1:
            follower, strayed = make(record.settings.follower), False
        elif follows and before and before.carried and (follower is None or strayed):
            follower, strayed = make(record.settings.follower), False
            carried.give(before.carried, follower)
        if seen is None:
            follower = None
        made = None
        if follower is not None and seen is not None:
            made = _step(follower, record, seen)
            strayed = strayed or differing(record.decision, made) is not None
        before = record
        yield Retraced(moment, made)


def _step(follower: Follower, record: DecisionRecord, seen: Observation) -> Decision:
    follower.ask(record.asked)
    try:
        return follower.step(seen, record.now_s)
    except (TypeError, AttributeError, IndexError, ValueError, ArithmeticError) as error:
        raise RecordingError(
            f"step {record.step} cannot be made again ({error!r:.200}): the recorded state is "
            "damaged, or of another version of this software"
        ) from error


def _moment(time_ns: int, record: DecisionRecord, inputs: Inputs) -> Moment:
    frame, picture, scan = None, None, None
    if record.frame is not None:
        frame, picture = inputs.frame(record.frame, record.settings.camera)
    if record.scan is not None:
        scan = inputs.scan(record.scan)
    complete = (frame is None) == (record.frame is None) and (scan is None) == (record.scan is None)
    return Moment(time_ns, record, Observation(frame, scan) if complete else None, picture)


def _view(camera: dict[str, Any] | None) -> View:
    """The view that the runtime had.

    Raises:
        RecordingError: the recorded camera is none.
    """
    try:
        return View(None if camera is None else CameraModel.from_dict(camera))
    except CameraError as error:
        raise RecordingError(f"the recorded camera is unusable: {error}") from error


def _keep(among: OrderedDict[int, list[Any]], stamp_ns: int, message: Any) -> None:
    """Keep the newest; a sensor that repeats itself, or has no stamps, is kept once or twice."""
    same = among.setdefault(stamp_ns, [])
    same.append(message)
    del same[:-KEPT]
    among.move_to_end(stamp_ns)
    while len(among) > KEPT:
        among.popitem(last=False)
