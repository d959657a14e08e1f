"""Robots set down anywhere along a long route: do they find their place, and arrive?"""

import functools
import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.errors import WorldError
from cbe.robot import STEP_S
from cbe_bench.episode import Outcome, ride
from cbe_bench.evaluation import RunConfig, Stage, each_episode, stored_route
from cbe_bench.jitter import is_kept
from cbe_bench.route import Teaching
from cbe_bench.tally import wilson
from cbe_hil_sim.world import World
from cbe_hil_sim.worldbatch import WorldBatch
from cbe_runtime.decision import Decision
from cbe_runtime.follower import Follower
from cbe_runtime.networks import Networks
from cbe_runtime.observation import Observation
from cbe_runtime.route import Route
from cbe_runtime.state import State

OFF_M, OFF_RAD = 0.3, math.radians(15.0)
LEFT_STEPS = 30  # of the route, at least: there is to be something to join
ON_TRACK_STEPS = 30  # 1.5 m at full speed
_TRIES = 100


@dataclass(frozen=True, slots=True)
class JoinConfig:
    """A run of `cbe-bench join`."""

    run: RunConfig
    teaching: Teaching = field(default_factory=Teaching)


@dataclass(frozen=True, slots=True)
class Joined:
    """One episode: set down at step `at` of the demonstration's.

    `found_s` is when it first went on, None if never; `error_steps` how far from the truth it
    then thought to be.
    """

    index: int
    at: int
    found_s: float | None
    error_steps: float | None
    outcome: Outcome

    @property
    def on_track(self) -> bool:
        """Whether it found its true place."""
        return self.error_steps is not None and self.error_steps <= ON_TRACK_STEPS

    @property
    def success(self) -> bool:
        """On track, and arrived."""
        return self.on_track and self.outcome is Outcome.ARRIVED


class _Joiner:
    """A follower that is told to find its place, and noted when it has."""

    def __init__(self, follower: Follower, route: Route) -> None:
        self._follower, self._route = follower, route
        self._step = 0
        self.found_s: float | None = None
        self.found_steps: float | None = None

    def start(self) -> None:
        self._follower.relocalise()

    def step(self, observation: Observation, now_s: float) -> Decision:
        decision = self._follower.step(observation, now_s)
        if decision.state is State.FOLLOWING and self.found_s is None and decision.place:
            self.found_s = now_s
            self.found_steps = decision.place.share_of(self._route) * self._route.steps
            self._step = round(now_s / STEP_S)
        return decision

    @property
    def found_at(self) -> int:
        """The step it was found in."""
        return self._step


def measure(config: JoinConfig) -> dict[str, Any]:
    """Set down and drive all; what `--json` holds.

    Raises:
        CbeError: the model, the world or an option cannot be used.
    """
    model_id = Networks.load(config.run.model).model_id
    episodes = each_episode(config.run, functools.partial(_drive, config), "joins", _rate)
    successes = sum(each.success for each in episodes)
    times_s = [each.found_s for each in episodes if each.found_s is not None]
    return {
        "episodes": len(episodes),
        "success": successes / len(episodes),
        "ci95": list(wilson(successes, len(episodes))),
        "on_track": sum(each.on_track for each in episodes) / len(episodes),
        "arrived": sum(each.outcome is Outcome.ARRIVED for each in episodes) / len(episodes),
        "median_s": statistics.median(times_s) if times_s else None,
        "outcomes": {
            kind.value: sum(each.outcome is kind for each in episodes) for kind in Outcome
        },
        "config": config.run.to_dict() | config.teaching.to_dict(),
        "model_id": model_id,
        "runs": [asdict(each) for each in episodes],
    }


def _rate(done: Sequence[Joined]) -> str:
    return f"success {sum(each.success for each in done) / len(done):.3f}"


def _drive(config: JoinConfig, stage: Stage) -> Joined:
    demonstration = stage.scenario.demonstration
    rng = np.random.default_rng([config.run.terms.seed, stage.scenario.index, 4])
    route, _ = stored_route(stage, config.teaching)
    at, start = _beside(stage.place.world, stage.place.batch, demonstration, rng)
    joiner = _Joiner(Follower(stage.networks, route), route)
    with stage.place.backend(noise=config.run.noise, rng=rng) as (backend, see):
        driven = ride(joiner, backend, see, demonstration[at:], start)
    error_steps = None
    if joiner.found_steps is not None:
        true_steps = at + _nearest(demonstration[at:], driven.poses[: joiner.found_at + 1])
        error_steps = abs(joiner.found_steps - true_steps)
    return Joined(stage.scenario.index, at, joiner.found_s, error_steps, driven.outcome)


def _nearest(demonstration: NDArray[np.float64], poses: NDArray[np.float64]) -> int:
    """The step of a demonstration (T, 3) that the last of the poses (S, 3) driven is nearest to.

    No further on than could be driven: a route may cross itself.
    """
    near = demonstration[: len(poses) + ON_TRACK_STEPS, :2] - poses[-1, :2]
    return int(np.hypot(*near.T).argmin())


def _beside(
    world: World,
    batch: WorldBatch,
    demonstration: NDArray[np.float64],
    rng: np.random.Generator,
) -> tuple[int, NDArray[np.float64]]:
    """A step of a demonstration (T, 3), and a pose (3,) off it, kept as jittered starts are."""
    for _ in range(_TRIES):
        at = int(rng.integers(0, len(demonstration) - LEFT_STEPS))
        angle = rng.uniform(-math.pi, math.pi)
        offset = OFF_M * np.array([math.cos(angle), math.sin(angle)])
        turn = OFF_RAD if rng.random() < 0.5 else -OFF_RAD
        start = demonstration[at] + np.array([*offset, turn])
        if is_kept(world, batch, start, demonstration[at]):
            return at, start
    raise WorldError(
        f"world {world.name!r} has no clear place {OFF_M} m off the drive; take another world"
    )
