"""Coming to rest in a pose: of the arcs a car can still drive, the one that ends nearest to it."""

import math

import numpy as np
from numpy.typing import NDArray

from cbe.controller import Motion
from cbe.geometry import wrap_angle
from cbe.robot import STEP_S, Robot

NEAR_M, NEAR_RAD = 0.5, math.radians(30.0)
"""Errors that weigh the same: what counts as the right place and the right heading."""
REACH_M = 0.9
"""What is farther away is not parked in."""
_CURVATURES, _APART_M = 41, 0.02
_SWERVE = 0.02  # what the tightest arc costs: a straight one is as good as that little better


class Parking:
    """Steers one robot, already on its last metre, into a pose; it never speeds up nor reverses.

    Obstacles are the stop zone's business.
    """

    def __init__(self, robot: Robot | None = None) -> None:
        """Lay out the arcs of `robot`."""
        self._robot = robot = robot or Robot()
        widest = robot.max_curvature_per_m
        curvature = np.linspace(-widest, widest, _CURVATURES)[:, None]  # the middle one is 0
        self._lengths_m = np.arange(0.0, REACH_M, _APART_M)
        turn = curvature * self._lengths_m  # (arcs, lengths)
        chord = self._lengths_m * np.sinc(turn / (2.0 * np.pi))
        self._ends = np.stack([chord * np.cos(turn / 2.0), chord * np.sin(turn / 2.0), turn])
        self._steer_rad = np.arctan(curvature[:, 0] * robot.wheelbase_m)
        self._effort = _SWERVE * (curvature / widest) ** 2

    def step(self, motion: Motion, rest: NDArray[np.float64]) -> Motion:
        """Next commanded motion (1,), 0.1 s on, towards rest in the pose `rest` (3,: x, y, yaw).

        `motion` is the present one, the pose in base_link. A non-finite pose brakes to a stop.
        """
        if not np.isfinite(rest).all():
            return Motion(np.zeros(1), motion.steer_rad)
        x, y, yaw = self._ends - rest[:, None, None]
        cost = (x * x + y * y) / NEAR_M**2 + (wrap_angle(yaw) / NEAR_RAD) ** 2 + self._effort
        arc, length = divmod(int(cost.argmin()), len(self._lengths_m))
        # Speed v with v * step + v^2 / (2 braking) = length.
        lost = self._robot.max_braking_mps2 * STEP_S
        left_m = self._lengths_m[length]
        allowed = math.sqrt(lost**2 + 2.0 * self._robot.max_braking_mps2 * left_m) - lost
        return Motion(np.minimum(motion.speed_mps, allowed), self._steer_rad[arc : arc + 1])
