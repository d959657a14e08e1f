"""Whether what the sensors say can be true, where each message by itself looks sound."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cbe_runtime.state import Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe_runtime.observation import Frame

BLANK_LEVELS = 3
"""Grey levels that a blank picture's pixels span at most, but for the outliers on either side."""
OUTLIERS = 0.025
"""Of all pixels: a door at the end of a white corridor, overexposed, takes up little more."""
BLACK_LEVEL = 8
"""A covered lens: no lit wall is as dark, however near."""
COVERED_SHARE = 0.4
"""Of all pixels that were ever lit, so many black at once are something before the lens."""
SEEN_SHARE = 0.1
"""Pixels that are not pure black, as what the narrowest camera that is accepted leaves is."""
WALL_M = 0.5
"""A plain wall nearer than this, in most directions ahead, fills the camera's view."""
MOVING_MPS = 0.1
RETRY_S = 3.0
"""A picture that stands still is believed again after this long: the scene may be still."""
FAR_M, MANY_RAYS = 7.0, 0.1
"""What many rays met within this range cannot be out of reach a step later."""


class PictureWatch:
    """Tells a camera that shows something from one that is covered, blinded or hangs.

    A blank picture counts as lost, one that something came before too, and one that is the very
    same as the last although the robot is to drive; without another one for `fresh_s` the robot
    stops.
    """

    def __init__(self, fresh_s: float) -> None:
        self._fresh_s = fresh_s
        self._stamp_ns: int | None = None
        self._image: NDArray[np.uint8] | None = None
        self._lit: NDArray[np.bool_] | None = None  # (32, 32) pixels that ever were
        self._shown_s: float | None = None
        self._why: Reason | None = None
        self._doubted_s: float | None = None

    @property
    def shows(self) -> bool:
        """Whether the newest frame is worth the networks' while."""
        return self._why is None

    def fault(
        self,
        frame: Frame,
        image: NDArray[np.uint8],
        ranges_m: NDArray[np.float64],
        speed_mps: float,
        now_s: float,
    ) -> Reason | None:
        """Judge the newest frame; call once a step.

        Args:
            frame: the newest one.
            image: its (64, 64, 3) RGB.
            ranges_m: (rays,) of the newest scan, over which a plain wall is recognised.
            speed_mps: commanded in the step before.
            now_s: on the clock of `received_s`.
        """
        if frame.stamp_ns != self._stamp_ns:
            self._stamp_ns = frame.stamp_ns
            self._why = self._judge(image, ranges_m, speed_mps, now_s)
            self._image = image
        if self._why is None or self._shown_s is None:
            self._shown_s = frame.received_s
        if now_s - self._shown_s <= self._fresh_s:
            return None
        if self._doubted_s is None:
            self._doubted_s = now_s
        return self._why

    def _judge(
        self,
        image: NDArray[np.uint8],
        ranges_m: NDArray[np.float64],
        speed_mps: float,
        now_s: float,
    ) -> Reason | None:
        bright = brightness(image)
        if is_blank(bright, wall=_before_a_wall(ranges_m)) or self._covered(bright):
            return Reason.BLANK_IMAGE
        repeats = self._image is not None and np.array_equal(image, self._image)
        if not repeats or is_blank(bright, wall=False):  # a plain wall looks the same all along
            self._doubted_s = None
            return None
        if self._doubted_s is not None:  # the robot stands because of it
            if now_s - self._doubted_s < RETRY_S:
                return Reason.FROZEN_CAMERA
            self._doubted_s = None
            return None
        return Reason.FROZEN_CAMERA if speed_mps > MOVING_MPS else None

    def _covered(self, bright: NDArray[np.uint8]) -> bool:
        """Whether much is black that was lit before, in this picture or an earlier one."""
        lit = bright > BLACK_LEVEL
        self._lit = lit if self._lit is None else self._lit | lit
        ever = np.count_nonzero(self._lit)
        return bool(ever - np.count_nonzero(lit) > COVERED_SHARE * ever)


class ReturnWatch:
    """Tells a lidar that sees nothing any more from one that nothing stands before."""

    def __init__(self) -> None:
        self._many = False

    def plausible(self, ranges_m: NDArray[np.float64]) -> bool:
        """Whether these ranges (rays,) can follow the last ones: walls do not go all at once."""
        if self._many and not np.isfinite(ranges_m).any():
            return False
        near = np.count_nonzero(ranges_m < FAR_M)
        self._many = bool(near >= MANY_RAYS * len(ranges_m))
        return True


def is_blank(bright: NDArray[np.uint8], *, wall: bool) -> bool:
    """Whether `brightness` (32, 32) shows nothing; before a `wall` it need not show more."""
    seen = bright > 0
    count = np.count_nonzero(seen)
    if count < SEEN_SHARE * bright.size:
        return True
    ordered = np.sort(bright, axis=None) if count == bright.size else np.sort(bright[_inside(seen)])
    outliers = int(OUTLIERS * len(ordered))
    low, high = int(ordered[outliers]), int(ordered[-1 - outliers])
    return high <= BLACK_LEVEL or (high - low <= BLANK_LEVELS and not wall)


def _inside(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (32, 32) without the rim of what a narrow camera covers, which is shaded."""
    inside = seen.copy()
    inside[1:] &= seen[:-1]
    inside[:-1] &= seen[1:]
    inside[:, 1:] &= seen[:, :-1]
    inside[:, :-1] &= seen[:, 1:]
    return inside if inside.any() else seen


def _before_a_wall(ranges_m: NDArray[np.float64]) -> bool:
    quarter = len(ranges_m) // 4
    ahead = ranges_m[quarter:-quarter]
    return bool(2 * np.count_nonzero(ahead < WALL_M) > len(ahead))


def brightness(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The brightest colour of every fourth pixel (32, 32) of a picture (64, 64, 3)."""
    some = image[::2, ::2]
    return np.maximum(np.maximum(some[..., 0], some[..., 1]), some[..., 2])
