"""What is asked of the follower, and what it decides, in one step."""

from __future__ import annotations

from dataclasses import dataclass

from cbe_runtime.joining import Whereabouts  # msgspec reads these types
from cbe_runtime.state import Reason, State


@dataclass(frozen=True, slots=True)
class Asked:
    """What was asked of the follower between two steps.

    `relocalise` is a start anywhere on the route, `near` where the robot is thought to be.
    """

    start: bool = False
    stop: bool = False
    relocalise: bool = False
    near: Whereabouts | None = None


@dataclass(frozen=True, slots=True)
class Decision:
    """What to command in this step, and why.

    `progress` is of the present segment; `waypoint_m` (x, y) in base_link at the present pose;
    ages are since receipt, inf where nothing was received; `standing` is the robot's own belief
    (the command and the braking that precedes it), `ticked` whether the networks ran. `lost` is
    the probability of being lost, `place` where the robot most likely is, if that is known.
    `gap_steps` is how many steps the robot may have driven between the last two frames that the
    networks saw: they are trained on 1 to 3.
    """

    speed_mps: float
    yaw_rate_rad_s: float
    state: State
    reason: Reason | None
    segment: int
    segments: int
    progress: float
    on_route: float
    waypoint_m: tuple[float, float] | None
    camera_age_s: float
    scan_age_s: float
    standing: bool
    ticked: bool
    lost: float = 0.0
    place: Whereabouts | None = None
    gap_steps: int = 0
