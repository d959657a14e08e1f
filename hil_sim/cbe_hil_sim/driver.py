"""Drives one robot of any backend along a path, as a demonstration is driven (Sec. IV-A)."""

import numpy as np
from numpy.typing import NDArray

from cbe.controller import Motion, RmpController, twist
from cbe.robot import Robot
from cbe.stop_zone import limit
from cbe_hil_sim.astar import SPACING_M
from cbe_hil_sim.backend import Observation
from cbe_hil_sim.demonstrator import ARRIVED_M, ARRIVED_SPEED_MPS, PathFollower

Twist = tuple[NDArray[np.float64], NDArray[np.float64]]


class Driver:
    """Follows one path (N, 2) in world metres with the scan in view."""

    def __init__(self, path: NDArray[np.float64], robot: Robot) -> None:
        """Any polyline will do; it is resampled."""
        self._robot = robot
        path = _resampled(path)
        self._follower = PathFollower([path])
        self._controller = RmpController(robot)
        self._commanded = Motion(np.zeros(1), np.zeros(1))
        self.patience_steps = 100 + round(30.0 * len(path) * SPACING_M / robot.max_speed_mps)
        """Three times what the path takes at full speed."""

    def command(self, poses: NDArray[np.float64], seen: Observation) -> Twist | None:
        """Next speed and yaw rate (1,) each at world poses (1, 3); None once it has arrived."""
        waypoint = self._follower.waypoint(poses)
        near = self._follower.end_distance_m(poses)[0] < ARRIVED_M
        if near and self._commanded.speed_mps[0] < ARRIVED_SPEED_MPS:
            return None
        wanted = self._controller.step(self._commanded, waypoint, seen.scans_m)
        self._commanded = limit(wanted, seen.scans_m, self._robot)
        return twist(self._commanded, self._robot)


def _resampled(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 2) each 0.05 m along a polyline."""
    travelled = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
    count = max(2, round(travelled[-1] / SPACING_M) + 1)
    at = np.linspace(0.0, travelled[-1], count)
    return np.stack([np.interp(at, travelled, path[:, axis]) for axis in (0, 1)], axis=-1)
