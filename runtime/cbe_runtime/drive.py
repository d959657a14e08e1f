"""A recorded drive as the frames that teaching needs: the model's view, one a step."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import CameraError, MessageError, RecordingError
from cbe.messages import CameraInfo, CompressedImage, Image
from cbe.robot import STEP_S
from cbe_runtime import mcapfile
from cbe_runtime.view import View

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from cbe.camera import CameraModel

logger = logging.getLogger(__name__)

STEP_NS = round(STEP_S * 1e9)
TOLERANCE_NS = 45_000_000
"""How early a frame may be for its step: just under half, so that jitter loses none."""
RESTART_NS = 1_000_000_000
"""Stamps that jump back by more than this come from a restarted clock."""
STILL_LEVELS = 0.5
"""Mean change, in grey levels, below which a frame shows the same place as the one before."""

IMAGE_TYPES: dict[str, type[CompressedImage | Image]] = {
    CompressedImage.TYPE: CompressedImage,
    Image.TYPE: Image,
}


class StepSampler:
    """Picks from a camera's frames those nearest to a grid of 0.1 s."""

    def __init__(self) -> None:
        self._origin_ns: int | None = None
        self._due_ns = 0

    def takes(self, stamp_ns: int) -> bool:
        """Whether the frame of this stamp is the next step's."""
        if self._origin_ns is None or stamp_ns < self._due_ns - STEP_NS - RESTART_NS:
            self._origin_ns = self._due_ns = stamp_ns
        if stamp_ns < self._due_ns - TOLERANCE_NS:
            return False
        passed = (stamp_ns + TOLERANCE_NS - self._origin_ns) // STEP_NS
        self._due_ns = self._origin_ns + (passed + 1) * STEP_NS
        return True


class MotionFilter:
    """Passes over frames that show no motion, so that waiting is not taught."""

    def __init__(self) -> None:
        self._kept: NDArray[np.int16] | None = None

    def moved(self, image: NDArray[np.uint8]) -> bool:
        """Whether the view (64, 64, 3) differs from the last one that did."""
        present = image.astype(np.int16)
        if self._kept is not None and np.abs(present - self._kept).mean() < STILL_LEVELS:
            return False
        self._kept = present
        return True


class StepFrames:
    """From a camera's messages to the views that teaching is fed with."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._sampler = StepSampler()
        self._motion = MotionFilter()
        self.damaged = 0
        """Frames left out because they do not decode."""

    def take(
        self, image_type: type[CompressedImage | Image], data: bytes, received_ns: int
    ) -> NDArray[np.uint8] | None:
        """The view (64, 64, 3) of a message in CDR, or None where it is not the next step's."""
        try:
            message = image_type.from_cdr(data)
            if not self._sampler.takes(message.stamp_ns or received_ns):
                return None
            seen = self._view(message)
        except (MessageError, CameraError) as error:
            self.damaged += 1
            logger.debug("left out a frame: %s", error)
            return None
        return seen if self._motion.moved(seen) else None


@dataclass(frozen=True, slots=True)
class RecordedDrive:
    """The camera of one recording, checked when opened and read from the start at every pass."""

    path: Path
    topic: str
    camera: CameraModel

    @classmethod
    def open(
        cls, path: Path, topic: str | None = None, camera: CameraModel | None = None
    ) -> RecordedDrive:
        """Find the camera's topic and calibration.

        Raises:
            RecordingError: there is no camera topic, or several and none is named.
            CameraError: the camera is not calibrated or covers too little.
        """
        types = _types(path)
        cameras = [name for name, type_name in types.items() if type_name in IMAGE_TYPES]
        chosen = _choose(path, cameras, topic)
        view = View(camera)
        info = _calibration_of(chosen, types)
        if info is not None:
            view.calibrate(CameraInfo.from_cdr(_first(path, info, types[info]).data))
        _render(view, _first(path, chosen, types[chosen]))
        assert view.camera is not None
        return cls(path, chosen, view.camera)

    def frames(self) -> Iterator[NDArray[np.uint8]]:
        """The drive's views (64, 64, 3) uint8 RGB, one a step; waiting and bad frames left out."""
        frames = StepFrames(View(self.camera))
        for message in mcapfile.read(self.path):
            if message.topic == self.topic and message.type_name in IMAGE_TYPES:
                seen = frames.take(
                    IMAGE_TYPES[message.type_name], message.data, message.log_time_ns
                )
                if seen is not None:
                    yield seen
        if frames.damaged:
            logger.warning("%s: left out %d frames that do not decode", self.path, frames.damaged)


def _types(path: Path) -> dict[str, str]:
    """The type of each topic's first message; holds on to no message, which may be large."""
    types: dict[str, str] = {}
    for message in mcapfile.read(path):
        types.setdefault(message.topic, message.type_name)
    return types


def _choose(path: Path, cameras: list[str], topic: str | None) -> str:
    if topic is not None and topic.lstrip("/") in {name.lstrip("/") for name in cameras}:
        return next(name for name in cameras if name.lstrip("/") == topic.lstrip("/"))
    if topic is None and len(cameras) == 1:
        return cameras[0]
    if not cameras:
        raise RecordingError(
            f"{path} holds no camera topic ({' or '.join(IMAGE_TYPES)}); record the camera"
        )
    listed = ", ".join(cameras[:10]) + (", ..." if len(cameras) > 10 else "")
    wanted = "several camera topics" if topic is None else f"no camera topic {topic}"
    raise RecordingError(f"{path} has {wanted}; choose one with --topic: {listed}")


def _calibration_of(topic: str, types: dict[str, str]) -> str | None:
    """The CameraInfo beside an image topic, or the only one there is."""
    infos = [name for name, type_name in types.items() if type_name == CameraInfo.TYPE]
    folders = {topic.rsplit("/", depth)[0] for depth in (1, 2)}
    beside = [name for name in infos if name.rsplit("/", 1)[0] in folders]
    if len(beside or infos) == 1:
        return (beside or infos)[0]
    return None


def _first(path: Path, topic: str, type_name: str) -> mcapfile.Recorded:
    """A topic's first message, known to be there."""
    return next(
        message
        for message in mcapfile.read(path)
        if (message.topic, message.type_name) == (topic, type_name)
    )


def _render(view: View, message: mcapfile.Recorded) -> None:
    """Let the view meet its first image, so that an unusable camera shows at once."""
    try:
        view(IMAGE_TYPES[message.type_name].from_cdr(message.data))
    except MessageError as error:
        raise RecordingError(
            f"the first image of {message.topic} does not decode ({error}); check the recording"
        ) from error
