"""The small interface that every simulated world shows: reset, observe, step."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Observation:
    """What B robots see: images (B, height, width, 3) uint8 RGB, scans (B, rays) float32 metres.

    A ray without a return is +inf.
    """

    images: NDArray[np.uint8]
    scans_m: NDArray[np.float32]


class Backend(Protocol):
    """B robots in simulated worlds, advanced in lock-step by 0.1 s."""

    @property
    def poses(self) -> NDArray[np.float64]:
        """World poses of base_link, (B, 3): x m, y m, yaw rad."""

    @property
    def clearance_m(self) -> NDArray[np.float32]:
        """Distance from each body's surface to the nearest obstacle, (B,); below 0 in contact."""

    @property
    def collided(self) -> NDArray[np.bool_]:
        """Whether each body has touched something since the last reset, (B,)."""

    def reset(self, poses: NDArray[np.float64]) -> None:
        """Put the robots at rest at world poses (B, 3)."""

    def observe(self) -> Observation:
        """Render cameras and scans at the present poses."""

    def step(self, speed_mps: NDArray[np.float64], yaw_rate_rad_s: NDArray[np.float64]) -> None:
        """Advance 0.1 s under the commanded twists, each (B,)."""
