"""Where an arriving robot comes to stand, and how far it still drives to get there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cbe.geometry import wrap_angle
from cbe.parking import REACH_M, Parking

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe.controller import Motion
    from cbe.robot import Robot


@dataclass(frozen=True, slots=True)
class BerthConfig:
    """When the end is held to be still ahead, wherever it was read."""

    nearing: float = 0.002  # unlikeness that a view must be below all before to be nearer
    well_past: float = 0.04  # above the lowest: the end lies behind, wherever it was read
    ahead_m: float = 0.02  # where a view is nearer, the end is held to be so far ahead at least
    beyond_m: float = 0.35  # farther than that past where it was read first, it is not sought
    trust: float = 0.4  # in what a view says, against what was read before
    held_up_m: float = 0.1


class Berth:
    """The pose of a route's end, read off each view and carried along by dead reckoning between.

    In wide bare halls the end is read as nearer than it is, by up to 0.5 m. The view tells: it
    gets ever more like the end's up to there and less so beyond (in validation worlds the most
    alike of views 0.1 m apart was within 0.1 m of the end for 114 of 120), so the robot creeps on
    while it does, but not on and on: of 1,533 validation arrivals with a wide camera none had gone
    more than 0.35 m beyond where it read the end first.
    """

    def __init__(self, robot: Robot, config: BerthConfig) -> None:
        self._parking = Parking(robot)
        self._config = config
        self._nearer = True  # the last view than all before
        self._driven_m = 0.0  # since it was taken
        self._longest_m = 0.0  # to drive in all
        self.taken = False
        """Whether the robot is on its way there."""
        self.lowest = 1.0
        """Unlikeness of the end's, of all views since it was taken."""
        self.most_doubt = 0.0
        """Probability of being off the route, of all views since it was taken the highest."""
        self.pose = np.zeros(3)
        """In base_link: x, y in m, yaw in rad."""

    @property
    def place_m(self) -> tuple[float, float]:
        """x, y of `pose`."""
        return float(self.pose[0]), float(self.pose[1])

    @property
    def held_up(self) -> bool:
        """Whether there is more to drive than a robot leaves when it comes to stand."""
        return float(self.pose[0]) > self._config.held_up_m

    def take(self, read: NDArray[np.float64], unlike: float, on_route: float) -> None:
        """Begin to park in the pose (3,) read off a view so unlike the end's."""
        self.taken, self.pose, self.lowest = True, read, unlike
        self.most_doubt = 1.0 - on_route
        self._nearer, self._driven_m = True, 0.0
        self._longest_m = min(max(float(read[0]), 0.0) + self._config.beyond_m, REACH_M)

    def look(self, read: NDArray[np.float64], unlike: float, on_route: float) -> None:
        """Take what the next view says, as for `take`."""
        self._nearer = unlike < self.lowest - self._config.nearing
        self.lowest = min(self.lowest, unlike)
        self.most_doubt = max(self.most_doubt, 1.0 - on_route)
        error = read - self.pose
        error[2] = wrap_angle(error[2])
        self.pose = self.pose + self._config.trust * error
        well_past = unlike > self.lowest + self._config.well_past
        self.pose[0] = min(self.pose[0], 0.0 if well_past else self._longest_m - self._driven_m)

    def carry(self, place_m: tuple[float, float], travel_m: float, turn_rad: float) -> None:
        """Take a step of the robot, after which the pose's place is `place_m` (x, y)."""
        self.pose = np.array([*place_m, self.pose[2] - turn_rad])
        self._driven_m += travel_m

    def step(self, motion: Motion) -> Motion:
        """Next commanded motion (1,), from the present one."""
        pose = self.pose.copy()
        if self._nearer and self._driven_m < self._longest_m:
            pose[0] = max(pose[0], self._config.ahead_m)
        return self._parking.step(motion, pose)
