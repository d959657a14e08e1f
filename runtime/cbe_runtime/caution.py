"""The older what it sees, the slower the robot drives."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cbe.controller import Motion
from cbe.robot import STEP_S

if TYPE_CHECKING:
    from cbe.robot import Robot

FULL_SHARE = 0.4
"""Of the freshness limit: up to 0.12 s of 0.3 s, one period of the sensors and its jitter."""


def allowed_share(age_s: float, fresh_s: float) -> float:
    """Share of the full speed, 0 to 1: all of it up to a normal age, none from `fresh_s` on."""
    share = (fresh_s - age_s) / ((1.0 - FULL_SHARE) * fresh_s)
    return min(max(share, 0.0), 1.0)


def slowed(motion: Motion, speed_mps: float, age_s: float, fresh_s: float, robot: Robot) -> Motion:
    """The motion (1,) at no more than the speed its age allows.

    From the present `speed_mps` it falls no faster than the robot can brake: what is commanded
    stays what is driven, and the waypoint is carried along truly.
    """
    braked_mps = speed_mps - robot.max_braking_mps2 * STEP_S
    cap_mps = max(allowed_share(age_s, fresh_s) * robot.max_speed_mps, braked_mps)
    return Motion(np.minimum(motion.speed_mps, cap_mps), motion.steer_rad)
