"""What the follower sees in one step, and whether it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cbe.signature import IMAGE_SIZE
from cbe_runtime.state import Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe.robot import Robot

MAX_INVALID_RAYS = 0.5
"""Share of NaN rays up to which the neighbours stand in for them."""


CLOCK_SET_NS = 1_000_000_000
"""A stamp further back than this is of a clock that was set; a nearer one of an older frame."""


@dataclass(frozen=True, slots=True)
class Frame:
    """The newest camera frame in the model's view.

    `image` is (64, 64, 3) uint8 RGB, or None where one was received but could not be decoded;
    `received_s` is the local monotonic time of receipt, or of capture where clocks are known to
    agree; `stamp_ns` the sender's capture time, negative for what could not be decoded.
    """

    image: NDArray[np.uint8] | None
    received_s: float
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Scan:
    """The newest scan on the robot's own rays.

    `ranges_m` is (rays,) float, +inf without a return, NaN where invalid, or None where a scan
    was received that does not fit the robot; times as in `Frame`.
    """

    ranges_m: NDArray[np.floating] | None
    received_s: float
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Observation:
    """The newest frame and scan; None where none was ever received."""

    frame: Frame | None
    scan: Scan | None


def newer(stamp_ns: int, than_ns: int | None) -> bool:
    """Whether a sample was taken after another: not if it is the same, or was overtaken.

    A clock may be set, forwards or back by more than a second: what comes then is newer too.
    """
    if than_ns is None or stamp_ns < 0:
        return stamp_ns != than_ns
    ahead_ns = stamp_ns - than_ns
    return ahead_ns > 0 or ahead_ns < -CLOCK_SET_NS


class StampWatch:
    """Tells a sensor that fell silent from one that keeps repeating itself.

    Silence shows in the local receipt time, a frozen sensor in a stamp that stands still or
    only falls behind.
    """

    def __init__(self, fresh_s: float, stale: Reason, frozen: Reason) -> None:
        self._fresh_s = fresh_s
        self._stale = stale
        self._frozen = frozen
        self._stamp_ns: int | None = None
        self._advanced_s = 0.0

    def fault(self, sample: Frame | Scan | None, now_s: float) -> Reason | None:
        """Judge the newest sample; call once a step."""
        if sample is None:
            return self._stale
        if newer(sample.stamp_ns, self._stamp_ns):
            self._stamp_ns = sample.stamp_ns
            self._advanced_s = sample.received_s
        if now_s - sample.received_s > self._fresh_s:
            return self._stale
        if now_s - self._advanced_s > self._fresh_s:
            return self._frozen
        return None

    def newest(self, sample: Frame | Scan) -> bool:
        """Whether nothing newer than this sample, or a copy of it, was ever judged."""
        return sample.stamp_ns == self._stamp_ns

    def age_s(self, now_s: float) -> float:
        """Since the newest sample came, however often it, or an older one, came again."""
        return now_s - self._advanced_s


def usable_image(frame: Frame) -> NDArray[np.uint8] | None:
    """The frame's image, or None unless it is (64, 64, 3) uint8."""
    image = frame.image
    if image is None or image.shape != (IMAGE_SIZE, IMAGE_SIZE, 3) or image.dtype != np.uint8:
        return None
    return image


def usable_ranges(scan: Scan, robot: Robot) -> NDArray[np.float64] | None:
    """The scan's ranges (rays,) float64 without NaN, or None if they cannot be relied on.

    A few NaN rays take the nearer of the valid neighbours' ranges; too many of them, a negative
    range or a wrong number of rays make the scan unusable.
    """
    if scan.ranges_m is None or scan.ranges_m.shape != (robot.scan_rays,):
        return None
    ranges = scan.ranges_m.astype(np.float64)
    invalid = np.isnan(ranges)
    if invalid.any():
        if invalid.mean() > MAX_INVALID_RAYS:
            return None
        valid = np.flatnonzero(~invalid)
        after = np.searchsorted(valid, np.flatnonzero(invalid))
        left = valid[np.maximum(after - 1, 0)]
        right = valid[np.minimum(after, len(valid) - 1)]
        ranges[invalid] = np.minimum(ranges[left], ranges[right])
    return ranges if ranges.min() >= 0.0 else None
