"""What the follower would do on a recording, without a robot."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cbe import topics
from cbe.errors import CameraError, MessageError
from cbe.messages import LaserScan
from cbe.rays import resample
from cbe.robot import STEP_S, Robot
from cbe_runtime import mcapfile
from cbe_runtime.drive import IMAGE_TYPES, StepSampler
from cbe_runtime.observation import Frame, Observation, Scan
from cbe_runtime.view import View

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cbe.messages import CompressedImage, Image
    from cbe_runtime.decision import Decision
    from cbe_runtime.drive import RecordedDrive
    from cbe_runtime.follower import Follower

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Replayed:
    """A decision with what it was made from; `picture` is the camera's message."""

    time_ns: int
    decision: Decision
    observation: Observation
    picture: CompressedImage | Image | None


def decisions(follower: Follower, drive: RecordedDrive, robot: Robot) -> Iterator[Decision]:
    """One decision a step of the recording, the robot starting with the first frame."""
    return (each.decision for each in replay(follower, drive, robot))


def replay(follower: Follower, drive: RecordedDrive, robot: Robot) -> Iterator[Replayed]:
    """Each step of the recording, the robot starting with the first frame.

    Where the recording has no scan, nothing is taken to be in the way. Recorded motion is what
    it is: the follower's own commands change nothing about the next frame.
    """
    view, sampler = View(drive.camera), StepSampler()
    ranges_m = np.full(robot.scan_rays, np.inf, np.float32)
    scanned = False
    follower.start()
    step = 0
    for message in mcapfile.read(drive.path):
        if message.type_name == LaserScan.TYPE:
            scanned = True
            try:
                ranges_m = resample(LaserScan.from_cdr(message.data), robot)
            except MessageError as error:
                logger.warning("left out a scan: %s", error)
        if message.topic != drive.topic or message.type_name not in IMAGE_TYPES:
            continue
        image, decoded, stamp_ns = None, None, message.log_time_ns
        try:
            decoded = IMAGE_TYPES[message.type_name].from_cdr(message.data)
            stamp_ns = decoded.stamp_ns or stamp_ns
            if not sampler.takes(stamp_ns):
                continue
            image = view(decoded)
        except (MessageError, CameraError) as error:
            logger.warning("a frame is unusable: %s", error)
        now_s = step * STEP_S
        seen = Observation(Frame(image, now_s, stamp_ns), Scan(ranges_m, now_s, step))
        picture = None if image is None else decoded
        yield Replayed(message.log_time_ns, follower.step(seen, now_s), seen, picture)
        step += 1
    if not scanned:
        logger.warning(
            "the recording has no %s: nothing was taken to be in the way", topics.SCAN.name
        )
