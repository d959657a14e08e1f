"""When the follower switches, parks, arrives and gives up: every figure of it in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cbe.signature import OVERRUN_M
from cbe_runtime.approach import ApproachConfig
from cbe_runtime.berth import BerthConfig
from cbe_runtime.joining import JoinConfig
from cbe_runtime.lost import LostConfig

if TYPE_CHECKING:
    from cbe_runtime.networks import Prediction


@dataclass(frozen=True, slots=True)
class FollowerConfig:
    """How the follower switches, arrives and gives up."""

    fresh_s: float = 0.3  # an older image or scan stops the robot
    switch_progress: float = 0.95  # phi >= 0.95 starts the next behavior, Sec. III-D
    arrival_progress: float = 0.95  # the same on the last behavior begins to park, where
    arrival_steps: float = 6.4  # no more is left: 0.95 of 256 steps is still 0.6 m from the end
    resting_progress: float = 0.85  # enough where the waypoint says that the end is here:
    resting_range_m: float = 0.05  # a progress that stalls below the threshold must not strand it
    walled_m: float = 1.0  # or, something standing so near ahead, where the last view is
    seen_unlike: float = 0.25  # as like the end's as that, and
    seen_range_m: float = 0.6  # the end is read to be so near
    progress_ticks: int = 2  # network ticks in a row that must agree, against flicker
    timeout_factor: float = 3.0  # a segment may take this many times the demonstration's steps
    timeout_steps: int = 100  # ... and this many more
    lost: LostConfig = field(default_factory=LostConfig)
    join: JoinConfig = field(default_factory=JoinConfig)
    berth: BerthConfig = field(default_factory=BerthConfig)
    approach: ApproachConfig = field(default_factory=ApproachConfig)

    def ends(self, prediction: Prediction, steps: int, *, last: bool) -> bool:
        """Whether a tick says that a behavior of so many steps, a route's last or not, is done."""
        progress = prediction.progress
        arrival = max(self.arrival_progress, 1.0 - self.arrival_steps / steps)
        if progress >= (arrival if last else self.switch_progress):
            return True
        range_m = math.hypot(*prediction.waypoint_m) - OVERRUN_M
        return progress >= self.resting_progress and range_m < self.resting_range_m

    def may_see_end(self, prediction: Prediction, range_m: float) -> bool:
        """Whether a view like the end's, read to be so near, is the end to park in.

        That is asked where the end may be right before a wall: heading for the waypoint, which
        runs on past it, the robot would dodge that.
        """
        return prediction.progress >= self.resting_progress and range_m <= self.seen_range_m
