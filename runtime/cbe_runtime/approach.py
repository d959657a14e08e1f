"""How much nearer a route's end has come, by what the views say, while the robot drove."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

MOST = 200
"""Readings kept: a robot that creeps 4 mm between two ticks still fills the stretch."""


@dataclass(frozen=True, slots=True)
class ApproachConfig:
    """Over what stretch that is asked."""

    over_m: float = 0.7
    within_m: float = 0.1  # readings so near either of its ends are averaged


class Approach:
    """How far ahead the end was read over the last stretch driven, by dead reckoning.

    In a uniform passage the views of one place and of the next are alike: the end stays ahead
    however far the robot drives, and where it comes to stand says nothing.
    """

    def __init__(self, config: ApproachConfig) -> None:
        self._config = config
        self._driven_m = 0.0
        self._read: deque[tuple[float, float]] = deque(maxlen=MOST)  # m driven by then, m ahead

    def carry(self, travel_m: float) -> None:
        """Take a step of the robot."""
        self._driven_m += travel_m

    def read(self, ahead_m: float) -> None:
        """Take how far ahead the next view shows the end."""
        self._read.append((self._driven_m, ahead_m))
        longest_m = self._config.over_m + self._config.within_m
        while self._driven_m - self._read[0][0] > longest_m:
            self._read.popleft()

    @property
    def nearer_m(self) -> float:
        """How much nearer it came; infinite where the robot has not driven as far."""
        over_m, within_m = self._config.over_m, self._config.within_m
        since_m = [(self._driven_m - driven_m, ahead_m) for driven_m, ahead_m in self._read]
        before = [ahead_m for ago_m, ahead_m in since_m if ago_m >= over_m - within_m]
        lately = [ahead_m for ago_m, ahead_m in since_m if ago_m <= within_m]
        if not before or not lately:
            return math.inf
        return sum(before) / len(before) - sum(lately) / len(lately)
