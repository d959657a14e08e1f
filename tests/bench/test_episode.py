"""Outcomes are judged by the true pose, whatever the follower believes."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from cbe.errors import CbeError
from cbe_bench.episode import Outcome, film, ride
from cbe_hil_sim.backend import Observation as Seen
from cbe_hil_sim.vehicle import Vehicle
from cbe_runtime.decision import Decision
from cbe_runtime.observation import Observation
from cbe_runtime.state import Reason, State

STEPS = 60


def straight(steps: int = STEPS) -> NDArray[np.float64]:
    """Poses (steps + 1, 3) along x at 0.05 m a step."""
    poses = np.zeros((steps + 1, 3))
    poses[:, 0] = 0.05 * np.arange(steps + 1)
    return poses


class OpenSpace:
    """`Backend` of one car on an empty plane; past `wall_x_m` it collides."""

    def __init__(self, wall_x_m: float = math.inf) -> None:
        self._vehicle = Vehicle(np.zeros((1, 3)))
        self._wall_x_m = wall_x_m

    @property
    def poses(self) -> NDArray[np.float64]:
        return self._vehicle.poses.copy()

    @property
    def clearance_m(self) -> NDArray[np.float32]:
        return np.array([self._wall_x_m - self._vehicle.poses[0, 0]], np.float32)

    @property
    def collided(self) -> NDArray[np.bool_]:
        return self.clearance_m < 0.0

    def reset(self, poses: NDArray[np.float64]) -> None:
        self._vehicle.reset(poses)

    def observe(self) -> Seen:
        return Seen(np.zeros((1, 64, 64, 3), np.uint8), np.full((1, 240), np.inf, np.float32))

    def step(self, speed_mps: NDArray[np.float64], yaw_rate_rad_s: NDArray[np.float64]) -> None:
        self._vehicle.step(speed_mps, yaw_rate_rad_s)


def decision(
    speed_mps: float = 0.5,
    yaw_rate_rad_s: float = 0.0,
    state: State = State.FOLLOWING,
    reason: Reason | None = None,
) -> Decision:
    return Decision(
        speed_mps=speed_mps, yaw_rate_rad_s=yaw_rate_rad_s, state=state, reason=reason,
        segment=0, segments=1, progress=0.0, on_route=1.0, waypoint_m=None,
        camera_age_s=0.0, scan_age_s=0.0, standing=speed_mps == 0.0, ticked=True,
    )  # fmt: skip


class Script:
    """A driver that plays decisions, the last one for ever."""

    def __init__(self, decisions: Iterator[Decision]) -> None:
        self._decisions = decisions
        self._now = decision(0.0)
        self.seen: list[Observation] = []

    def start(self) -> None:
        pass

    def step(self, observation: Observation, now_s: float) -> Decision:
        self.seen.append(observation)
        self._now = next(self._decisions, self._now)
        return self._now


@pytest.fixture
def drive_then_arrive() -> Callable[[int], Script]:
    """Full speed straight on for so many steps, then ARRIVED and braking."""

    def make(steps: int) -> Script:
        going = [decision() for _ in range(steps)]
        return Script(iter([*going, decision(0.0, state=State.ARRIVED)]))

    return make


START = np.zeros(3)


def view(image):
    return image


def run(script, start=START, backend=None, demonstration=None):
    if demonstration is None:
        demonstration = straight()
    return ride(script, backend or OpenSpace(), view, demonstration, start)


def test_arrival_at_the_goal_is_a_success(drive_then_arrive) -> None:
    done = run(drive_then_arrive(STEPS + 3))
    assert done.outcome is Outcome.ARRIVED
    assert done.reached
    assert done.final_error_m < 0.2


def test_error_is_measured_after_braking(drive_then_arrive) -> None:
    # Declared at 0.55 m; the braking distance from 0.5 m/s is 0.06 m.
    done = run(drive_then_arrive(STEPS - 11 + 2))
    assert done.outcome is Outcome.ARRIVED
    assert math.isclose(done.final_error_m, 0.5, abs_tol=0.05)
    moved = np.hypot(*np.diff(done.poses[-2:, :2], axis=0)[0])
    assert moved < 1e-3


def test_arrival_declared_early_is_false(drive_then_arrive) -> None:
    done = run(drive_then_arrive(STEPS // 2))
    assert done.outcome is Outcome.FALSE_ARRIVAL
    assert not done.reached


def test_arrival_facing_elsewhere_is_false_but_the_papers_success() -> None:
    goal = straight()
    goal[-1, 2] = math.radians(31.0)
    turned = [*[decision()] * (STEPS + 3), decision(0.0, state=State.ARRIVED)]
    done = run(Script(iter(turned)), demonstration=goal)
    assert done.outcome is Outcome.FALSE_ARRIVAL
    assert done.reached


def test_touching_something_ends_it_even_after_arrival(drive_then_arrive) -> None:
    stopping_m = 0.05 * (STEPS - 1)
    done = run(drive_then_arrive(STEPS), backend=OpenSpace(wall_x_m=stopping_m))
    assert done.outcome is Outcome.COLLISION
    assert done.reached  # before it failed


def test_leaving_the_demonstration_ends_it() -> None:
    done = run(Script(iter([decision()])), start=np.array([0.0, 0.0, math.pi / 2]))
    assert done.outcome is Outcome.OFF_ROUTE
    assert 1.0 < done.poses[-1, 1] < 1.1


def test_driving_past_the_goal_ends_off_route() -> None:
    done = run(Script(iter([decision()])))
    assert done.outcome is Outcome.OFF_ROUTE
    assert done.reached


def test_standing_still_is_stuck_after_100_ticks() -> None:
    done = run(Script(iter([decision(0.0)])))
    assert done.outcome is Outcome.STUCK
    assert done.steps == 100


def test_circling_runs_into_the_timeout() -> None:
    # A circle of 0.43 m radius stays within 1 m of the path but is no standstill.
    done = run(Script(iter([decision(0.5, 1.16)])))
    assert done.outcome is Outcome.TIMEOUT
    assert done.steps == 3 * STEPS + 100


def test_followers_own_timeout_counts_as_one() -> None:
    stopped = decision(0.0, state=State.STOPPED, reason=Reason.TIMEOUT)
    done = run(Script(iter([decision(), stopped])))
    assert done.outcome is Outcome.TIMEOUT


def test_follower_that_breaks_down_is_an_error_not_an_outcome() -> None:
    stopped = decision(0.0, state=State.STOPPED, reason=Reason.MODEL_FAULT)
    with pytest.raises(CbeError, match="MODEL_FAULT"):
        run(Script(iter([stopped])))


def test_nearest_sample_is_not_sought_across_a_loop() -> None:
    # Out and back: at the far end the way back is as near as the way out.
    there = straight(100)
    back = there[::-1] + np.array([0.0, 0.3, math.pi])
    done = run(
        Script(iter([*[decision()] * 60, decision(0.0, state=State.ARRIVED)])),
        demonstration=np.concatenate([there, back]),
    )
    assert done.outcome is Outcome.FALSE_ARRIVAL


def test_stamps_advance_by_a_step() -> None:
    script = Script(iter([decision(0.0)]))
    run(script)
    stamps = [seen.frame.stamp_ns for seen in script.seen[:3]]
    assert stamps == [0, 100_000_000, 200_000_000]


class Milestones(OpenSpace):
    """Shows how far along x it is."""

    def observe(self) -> Seen:
        level = round(float(self.poses[0, 0]) / 0.05)
        return Seen(np.full((1, 64, 64, 3), level, np.uint8), np.full((1, 240), np.inf, np.float32))


@pytest.mark.parametrize(("steps", "seen"), [(4, [0, 0, 2, 2, 4]), (5, [0, 0, 2, 2, 4, 5])])
def test_film_of_every_second_step_looks_from_those_and_the_last(steps, seen) -> None:
    views = film(Milestones(), lambda image: image, straight(steps), every=2)
    assert [int(view[0, 0, 0]) for view in views] == seen
