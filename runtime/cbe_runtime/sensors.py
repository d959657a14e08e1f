"""The newest camera frame and scan from the link, in the follower's terms."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from cbe import topics
from cbe.errors import CameraError, CbeError, MessageError
from cbe.rays import resample
from cbe_runtime.observation import Frame, Observation, Scan

if TYPE_CHECKING:
    from cbe.camera import CameraModel
    from cbe.inbox import Latest, Received
    from cbe.link import Link
    from cbe.messages import CompressedImage, Image, LaserScan
    from cbe.robot import Robot
    from cbe_runtime.view import View

logger = logging.getLogger(__name__)

CLOCKS_AGREE_S = 0.02
"""By how much a stamp may lie in the future."""
REFUSED_S = 1.0
"""What comes too late counts as this old at least: stale at once."""


class Sensors:
    """Reads the camera (raw where no compressed one was heard first), its calibration and scan.

    What is received but cannot be used becomes a sample without content: the follower names it.

    With `max_latency_s`, the senders' clocks agree with this one: ages count from the stamps, and
    what comes later than that after its stamp is stale when it comes. Without, a constant latency
    cannot be seen.
    """

    def __init__(
        self, link: Link, view: View, robot: Robot, max_latency_s: float | None = None
    ) -> None:
        self._compressed = link.latest(topics.CAMERA)
        self._raw = link.latest(topics.CAMERA_RAW)
        self._camera: Latest[CompressedImage] | Latest[Image] = self._compressed
        self._scans = link.latest(topics.SCAN)
        self._infos = link.latest(topics.CAMERA_INFO)
        self._view = view
        self._robot = robot
        self._max_latency_s = max_latency_s
        self._frame: Frame | None = None
        self._frame_received_s = -math.inf
        self._scan: Scan | None = None
        self._counts = {"camera": 0, "scan": 0, "info": 0}
        self._complaint = ""

    @property
    def calibration(self) -> CameraModel | None:
        """Of the camera in use; None before the first calibration or image."""
        return self._view.camera

    def observe(self) -> Observation:
        """The newest frame and scan; each message is decoded once."""
        self._calibrate()
        self._choose_camera()
        image = self._camera.get()
        if image is not None and self._is_new("camera", image.count):
            self._frame_received_s = image.received_s
            self._frame = self._framed(image)
        scan = self._scans.get()
        if scan is not None and self._is_new("scan", scan.count):
            self._scan = self._scanned(scan)
        return Observation(self._frame, self._scan)

    @property
    def frame_received_s(self) -> float:
        """When, by the local monotonic clock, the newest frame seen came; -inf before the first."""
        return self._frame_received_s

    def wait_for_frame(self, timeout_s: float) -> bool:
        """Whether a frame that `observe` has not seen came within the time."""
        self._choose_camera()
        return self._camera.wait(self._counts["camera"], timeout_s) is not None

    def wait_for_frame_since(self, since_s: float, timeout_s: float) -> bool:
        """Whether a frame came since some monotonic time, or does within the time to come."""
        self._choose_camera()
        newest = self._camera.get()
        if newest is not None and newest.received_s >= since_s:
            return True
        return self._camera.wait(newest.count if newest else 0, timeout_s) is not None

    def wait_for_scan(self, timeout_s: float) -> bool:
        """Whether a scan that `observe` has not seen came within the time."""
        return self._scans.wait(self._counts["scan"], timeout_s) is not None

    def drops(self) -> dict[str, dict[str, int]]:
        """Per sensor: messages received, overwritten unread, lost on the way, malformed."""
        return {"camera": asdict(self._camera.stats), "scan": asdict(self._scans.stats)}

    def _is_new(self, sensor: str, count: int) -> bool:
        new = count != self._counts[sensor]
        self._counts[sensor] = count
        return new

    def _choose_camera(self) -> None:
        if self._frame is None and not self._compressed.stats.received:
            self._camera = self._raw if self._raw.stats.received else self._compressed

    def _calibrate(self) -> None:
        info = self._infos.get()
        if info is None or not self._is_new("info", info.count) or info.message is None:
            return
        try:
            self._view.calibrate(info.message)
        except CameraError as error:
            self._complain(error)

    def _framed(self, received: Received[Any]) -> Frame:
        message = received.message
        try:
            if message is not None:
                taken_s = self._taken_s(received.received_s, message.stamp_ns)
                return Frame(self._view(message), taken_s, message.stamp_ns)
            self._complain(received.error)
        except (MessageError, CameraError) as unusable:
            self._complain(unusable)
        # Every unreadable message counts as a new one, so that it is named bad and not frozen.
        return Frame(None, received.received_s, -received.count)

    def _scanned(self, received: Received[LaserScan]) -> Scan:
        message = received.message
        try:
            if message is not None:
                ranges_m = resample(message, self._robot)
                taken_s = self._taken_s(received.received_s, message.stamp_ns)
                return Scan(ranges_m, taken_s, message.stamp_ns)
            self._complain(received.error)
        except MessageError as unusable:
            self._complain(unusable)
        return Scan(None, received.received_s, -received.count)

    def _taken_s(self, received_s: float, stamp_ns: int) -> float:
        """Since when a message ages: its receipt, or its stamp where clocks agree."""
        if self._max_latency_s is None:
            return received_s
        received_ns = time.time_ns() - round(1e9 * (time.monotonic() - received_s))
        latency_s = (received_ns - stamp_ns) / 1e9
        if -CLOCKS_AGREE_S <= latency_s <= self._max_latency_s:
            return received_s - max(latency_s, 0.0)
        self._complain(
            MessageError(
                f"stamps are more than {self._max_latency_s:g} s (--max-latency) old when they "
                "come: the network or the sender is too slow, or the clocks disagree"
                if latency_s > 0.0
                else "stamps lie in the future: --max-latency needs clocks that agree (chrony)"
            )
        )
        return received_s - max(abs(latency_s), REFUSED_S)

    def _complain(self, error: CbeError | None) -> None:
        """Log what is wrong once, not at 10 Hz."""
        complaint = str(error)
        if complaint != self._complaint:
            logger.warning("%s", complaint)
        self._complaint = complaint
