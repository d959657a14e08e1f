"""One closed-loop episode in simulated time: a follower drives, its outcome is judged by truth."""

import math
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cbe import geometry
from cbe.errors import CbeError
from cbe.robot import STEP_S
from cbe_bench.place import See
from cbe_hil_sim.backend import Backend
from cbe_runtime.decision import Decision
from cbe_runtime.observation import Frame, Observation, Scan
from cbe_runtime.state import Reason, State

SUCCESS_M, SUCCESS_RAD = 0.5, math.radians(30.0)
PAPER_SUCCESS_M = 0.54
OFF_ROUTE_M = 1.0
STUCK_M, STUCK_TICKS = 0.2, 100
TIMEOUT_FACTOR, TIMEOUT_STEPS = 3, 100
_SEARCH_BACK, _SEARCH_AHEAD = 10, 30  # samples round the last nearest: drives cross themselves
_STANDING_M = 1e-3  # moved in one step
BRAKING_STEPS = 50
_HONEST = {None, Reason.TIMEOUT, Reason.BLANK_IMAGE, Reason.FROZEN_CAMERA}
"""What may stop a follower here; another fault is of the simulation or the networks."""


class Outcome(StrEnum):
    """How an episode ended; only `ARRIVED` is a success."""

    ARRIVED = "arrived"
    COLLISION = "collision"
    OFF_ROUTE = "off_route"
    STUCK = "stuck"
    TIMEOUT = "timeout"
    FALSE_ARRIVAL = "false_arrival"  # declared, but too far away or turned


class Driver(Protocol):
    """What is evaluated: the runtime's follower, or a script in its place."""

    def start(self) -> None:
        """Ask to follow the route."""

    def step(self, observation: Observation, now_s: float) -> Decision:
        """Decide what to command for the next 0.1 s."""


@dataclass(frozen=True, slots=True)
class Ride:
    """A driven episode; `poses` (T, 3) are true, one a step, the start's first.

    The errors are of the last pose against the demonstration's last; `reached` tells whether the
    robot was ever within 0.54 m of it.
    """

    outcome: Outcome
    reached: bool
    final_error_m: float
    final_error_rad: float
    min_clearance_m: float
    poses: NDArray[np.float64]

    @property
    def steps(self) -> int:
        """Steps driven."""
        return len(self.poses) - 1

    @property
    def length_m(self) -> float:
        """Distance driven."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())


def ride(
    driver: Driver,
    backend: Backend,
    see: See,
    demonstration: NDArray[np.float64],
    start: NDArray[np.float64],
) -> Ride:
    """Let `driver` repeat `demonstration` (T, 3) from rest at `start` (3,).

    Raises:
        CbeError: the follower stopped for a fault of the simulation or of its networks.
    """
    backend.reset(start[None])
    driver.start()
    judge = Judge(demonstration, start)
    ended: Outcome | None = None
    arrived_at: int | None = None
    for step in range(judge.timeout_steps + BRAKING_STEPS):
        decision = driver.step(observe(backend, see, step), step * STEP_S)
        backend.step(np.array([decision.speed_mps]), np.array([decision.yaw_rate_rad_s]))
        judge.moved(backend)
        if decision.reason not in _HONEST:
            raise CbeError(f"the follower stopped in simulation: {decision.reason}")
        if decision.state is State.ARRIVED:
            arrived_at = step if arrived_at is None else arrived_at
        if bool(backend.collided[0]):
            ended = Outcome.COLLISION
        elif arrived_at is not None:
            if judge.standing or step - arrived_at >= BRAKING_STEPS:
                ended = judge.arrival()
        else:
            ended = judge.failure(decision)
        if ended is not None:
            break
    return judge.ride(ended or Outcome.TIMEOUT)


class Judge:
    """Follows the true pose along the demonstration."""

    def __init__(self, demonstration: NDArray[np.float64], start: NDArray[np.float64]) -> None:
        self._demonstration = demonstration
        self.timeout_steps = TIMEOUT_FACTOR * (len(demonstration) - 1) + TIMEOUT_STEPS
        self._poses = [np.array(start)]
        self._nearest = 0
        self._offset_m = 0.0
        self._ticks: deque[NDArray[np.float64]] = deque(maxlen=STUCK_TICKS)
        self._clearance_m = math.inf
        self._reached = False

    def moved(self, backend: Backend) -> None:
        """Take the pose after a step."""
        pose = backend.poses[0]
        self._poses.append(pose)
        self._clearance_m = min(self._clearance_m, float(backend.clearance_m[0]))
        first = max(self._nearest - _SEARCH_BACK, 0)
        near = self._demonstration[first : self._nearest + _SEARCH_AHEAD + 1]
        distance = np.hypot(*(near[:, :2] - pose[:2]).T)
        self._nearest = first + int(distance.argmin())
        self._offset_m = float(distance.min())
        # As the paper has it: an oracle would have stopped the robot here.
        self._reached |= self._error()[0] < PAPER_SUCCESS_M

    @property
    def moved_m(self) -> float:
        """Distance between the last two poses; 0 at the start."""
        return float(np.hypot(*(self._poses[-1] - self._poses[-2:][0])[:2]))

    @property
    def standing(self) -> bool:
        """Whether the robot did not move in the last step."""
        return self.moved_m < _STANDING_M

    def arrival(self) -> Outcome:
        """Judge the standing robot that declared its arrival."""
        error_m, error_rad = self._error()
        near = error_m <= SUCCESS_M and error_rad <= SUCCESS_RAD
        return Outcome.ARRIVED if near else Outcome.FALSE_ARRIVAL

    def failure(self, decision: Decision) -> Outcome | None:
        """What ends the episode of a robot still on its way, if anything does."""
        if self._offset_m > OFF_ROUTE_M:
            return Outcome.OFF_ROUTE
        if decision.ticked:
            self._ticks.append(self._poses[-1][:2])
            moved = np.hypot(*(np.array(self._ticks) - self._ticks[0]).T)
            if len(self._ticks) == STUCK_TICKS and moved.max() < STUCK_M:
                return Outcome.STUCK
        timed_out = decision.reason is Reason.TIMEOUT or len(self._poses) > self.timeout_steps
        return Outcome.TIMEOUT if timed_out else None

    def ride(self, outcome: Outcome) -> Ride:
        """The episode as it ended."""
        return Ride(
            outcome, self._reached, *self._error(), self._clearance_m, np.array(self._poses)
        )

    def _error(self) -> tuple[float, float]:
        error = geometry.relative(self._demonstration[-1], self._poses[-1])
        return float(np.hypot(error[0], error[1])), abs(float(error[2]))


def observe(backend: Backend, see: See, step: int) -> Observation:
    """What a follower is given in a step, just received."""
    seen = backend.observe()
    now_s, stamp_ns = step * STEP_S, round(step * STEP_S * 1e9)
    return Observation(
        Frame(see(seen.images[0]), now_s, stamp_ns), Scan(seen.scans_m[0], now_s, stamp_ns)
    )


def film(
    backend: Backend, see: See, poses: NDArray[np.float64], every: int = 1
) -> list[NDArray[np.uint8]]:
    """The networks' views from poses (T, 3), as a camera driven along them sees them.

    Of each `every` poses the first is looked from, and the last of all; between them a view stays.
    """
    views: list[NDArray[np.uint8]] = []
    for step, pose in enumerate(poses):
        if step % every == 0 or step == len(poses) - 1:
            backend.reset(pose[None])
            views.append(see(backend.observe().images[0]))
        else:
            views.append(views[-1])
    return views
