"""Where an arriving robot comes to stand, and how far it still drives to get there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cbe.parking import REACH_M, Parking
from cbe_runtime.likeness import NEARER

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe.controller import Motion
    from cbe.robot import Robot


@dataclass(frozen=True, slots=True)
class BerthConfig:
    """When the end is held to be still ahead, wherever it was read."""

    nearing: float = NEARER  # unlikeness that a view must be below all before to be nearer
    past: float = 0.012  # above the lowest: the end lies behind
    well_past: float = 0.04  # likewise, even if it was read farther on
    looks: int = 2  # in a row that are not nearer, likewise
    ahead_m: float = 0.05  # the end is held to be so far ahead: it creeps on
    held_up_m: float = 0.1


class Berth:
    """The pose of a route's end, read off a view and then carried along by dead reckoning.

    In wide bare halls the end is read as nearer than it is, by up to 0.5 m. The view tells: it
    gets ever more like the end's up to there and less so beyond (in validation worlds the most
    alike of views 0.1 m apart was within 0.1 m of the end for 114 of 120), so the robot does not
    stop while it does.
    """

    def __init__(self, robot: Robot, config: BerthConfig) -> None:
        self._parking = Parking(robot)
        self._config = config
        self._vain = 0  # looks in a row that were not nearer
        self._driven_m = 0.0  # since it was taken
        self._beyond = False  # where the end was read
        self.taken = False
        """Whether the robot is on its way there."""
        self.lowest = 1.0
        """Unlikeness of the end's, of all views since it was taken."""
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

    def take(self, pose: NDArray[np.float64], unlike: float) -> None:
        """Begin to park in `pose` (3,); the view is so unlike the end's."""
        self.taken, self.pose, self.lowest = True, pose, unlike
        self._vain, self._driven_m, self._beyond = 0, 0.0, False

    def look(self, unlike: float) -> None:
        """Take how unlike the end's the next view is."""
        nearer = unlike < self.lowest - self._config.nearing
        past = unlike > self.lowest + self._config.past
        self._vain = 0 if nearer else self._vain + (self._config.looks if past else 1)
        self.lowest = min(self.lowest, unlike)
        if (self._beyond and not self._ahead) or unlike > self.lowest + self._config.well_past:
            self.pose[0] = min(self.pose[0], 0.0)

    @property
    def _ahead(self) -> bool:
        return self._vain < self._config.looks and self._driven_m < REACH_M

    def carry(self, place_m: tuple[float, float], travel_m: float, turn_rad: float) -> None:
        """Take a step of the robot, after which the pose's place is `place_m` (x, y)."""
        self.pose = np.array([*place_m, self.pose[2] - turn_rad])
        self._driven_m += travel_m
        if self._ahead and self.pose[0] < self._config.ahead_m:
            self.pose[0], self._beyond = self._config.ahead_m, True

    def step(self, motion: Motion) -> Motion:
        """Next commanded motion (1,), from the present one."""
        return self._parking.step(motion, self.pose)
