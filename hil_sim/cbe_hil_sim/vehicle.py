"""The vehicle: B kinematic bicycles with rate limits and the paper's actuation noise."""

import numpy as np
from numpy.typing import NDArray

from cbe.controller import Motion, motion_from_twist
from cbe.geometry import wrap_angle
from cbe.robot import STEP_S, Robot

SUBSTEPS = 10


class Vehicle:
    """State of B cars: `poses` (B, 3) world, `speed_mps` (B,), `steer_rad` (B,)."""

    def __init__(
        self,
        poses: NDArray[np.float64],
        robot: Robot | None = None,
        *,
        noise: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Put cars at rest. `noise` is the paper's s; above 0 it needs `rng`."""
        if noise > 0.0 and rng is None:
            raise ValueError("actuation noise needs a random generator: pass rng=")
        self.robot = robot or Robot()
        self._noise, self._rng = noise, rng
        self.reset(poses)

    def reset(self, poses: NDArray[np.float64]) -> None:
        """Put the cars at rest at world poses (B, 3), steering straight."""
        self.poses = np.array(poses, dtype=np.float64)
        self.speed_mps = np.zeros(len(self.poses))
        self.steer_rad = np.zeros(len(self.poses))

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the cars that are not chosen (B,)."""
        self.poses = self.poses[chosen]
        self.speed_mps, self.steer_rad = self.speed_mps[chosen], self.steer_rad[chosen]

    @property
    def motion(self) -> Motion:
        """Present speed and steering."""
        return Motion(self.speed_mps.copy(), self.steer_rad.copy())

    def step(self, speed_mps: NDArray[np.float64], yaw_rate_rad_s: NDArray[np.float64]) -> None:
        """Advance 0.1 s under the commanded twists, each (B,).

        The yaw rate is turned into a steering angle at the twist's own speed; a car that
        commands standstill holds its steering.
        """
        robot = self.robot
        target = motion_from_twist(speed_mps, yaw_rate_rad_s, self.steer_rad, robot)
        target_speed = target.speed_mps * self._scale()
        target_speed = np.clip(target_speed, 0.0, robot.max_speed_mps)
        target_steer = target.steer_rad * self._scale()
        target_steer = np.clip(target_steer, -robot.max_steer_rad, robot.max_steer_rad)
        dt = STEP_S / SUBSTEPS
        for _ in range(SUBSTEPS):
            self.speed_mps = self.speed_mps + np.clip(
                target_speed - self.speed_mps,
                -robot.max_braking_mps2 * dt,
                robot.max_acceleration_mps2 * dt,
            )
            turn = robot.max_steer_rate_rad_s * dt
            self.steer_rad = self.steer_rad + np.clip(target_steer - self.steer_rad, -turn, turn)
            turned = self.speed_mps * np.tan(self.steer_rad) / robot.wheelbase_m * dt
            heading = self.poses[:, 2] + 0.5 * turned
            self.poses[:, 0] += self.speed_mps * np.cos(heading) * dt
            self.poses[:, 1] += self.speed_mps * np.sin(heading) * dt
            self.poses[:, 2] += turned
        self.poses[:, 2] = wrap_angle(self.poses[:, 2])

    def _scale(self) -> NDArray[np.float64]:
        """Random factor (B,): u = clip(x, -s, s) + 1, x ~ N(0, s / 2) (paper, Sec. IV-B)."""
        if self._rng is None or self._noise <= 0.0:
            return np.ones(len(self.poses))
        s = self._noise
        return np.asarray(np.clip(self._rng.normal(0.0, s / 2.0, len(self.poses)), -s, s) + 1.0)
