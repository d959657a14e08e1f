"""Robots carried elsewhere, or given another route's memory: do they notice, and how soon?"""

import functools
import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.errors import WorldError
from cbe.robot import STEP_S
from cbe_bench.episode import Judge, Outcome, observe
from cbe_bench.evaluation import RunConfig, Stage, each_episode, stored_route
from cbe_bench.place import Place
from cbe_bench.route import Teaching
from cbe_bench.tally import wilson
from cbe_hil_sim.demonstrator import ENDPOINT_CLEARANCE_M
from cbe_runtime.decision import Decision
from cbe_runtime.follower import Follower
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.networks import Networks
from cbe_runtime.state import State

FAR_M = 2.0  # from all of the demonstration, where that is of the same world
EARLIEST, LATEST = 0.2, 0.8  # when a robot is carried away, as shares of the demonstration
IN_TIME_S = 5.0
WATCHED_S = 30.0  # after the event, whether it declares an arrival
STOPS = (0.5, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98)


class Kind(StrEnum):
    """What is done to the robot, and where it then is."""

    WRONG_ROUTE = "wrong route"
    WRONG_WORLD = "wrong route of another world"
    CARRIED = "carried elsewhere"
    CARRIED_FAR = "carried into another world"

    @property
    def midway(self) -> bool:
        """Whether it was on its way."""
        return self in {Kind.CARRIED, Kind.CARRIED_FAR}

    @property
    def abroad(self) -> bool:
        """Whether it is in another world than its memory."""
        return self in {Kind.WRONG_WORLD, Kind.CARRIED_FAR}


@dataclass(frozen=True, slots=True)
class KidnapConfig:
    """A run of `cbe-bench kidnap`; `stop` is tried in place of the follower's own."""

    run: RunConfig
    teaching: Teaching = field(default_factory=Teaching)
    stop: float | None = None

    @property
    def follower(self) -> FollowerConfig:
        """The follower's settings."""
        usual = FollowerConfig()
        if self.stop is None:
            return usual
        return replace(usual, lost=replace(usual.lost, stop=self.stop))


@dataclass(frozen=True, slots=True)
class Kidnapping:
    """One episode; times in s since the event.

    `before` and `after` are the highest beliefs to be lost until the event, 0 where it came
    first, and within 5 s of it.
    """

    index: int
    kind: Kind
    lost_s: float | None
    arrived_s: float | None
    arrived_truly: bool
    collided: bool
    before: float
    after: float

    @property
    def in_time(self) -> bool:
        """LOST within 5 s."""
        return self.lost_s is not None and self.lost_s <= IN_TIME_S

    @property
    def false_arrival(self) -> bool:
        """ARRIVED where it was not."""
        return self.arrived_s is not None and not self.arrived_truly


def measure(config: KidnapConfig) -> dict[str, Any]:
    """Drive all episodes, a quarter of each kind; what `--json` holds.

    `curve` tells what other thresholds would do, as far as they lie below the one in use: the
    share of robots lost within 5 s, and of those on their way that are held for lost before
    anything was done to them.

    Raises:
        CbeError: the model, the world or an option cannot be used.
    """
    model_id = Networks.load(config.run.model).model_id
    episodes = each_episode(config.run, functools.partial(_drive, config), "kidnappings", _rate)
    midway = [each for each in episodes if each.kind.midway]
    stop = config.follower.lost.stop
    return _tally(episodes) | {
        "kinds": {
            kind.value: _tally([each for each in episodes if each.kind is kind]) for kind in Kind
        },
        "curve": [
            {
                "stop": threshold,
                "lost_within_5s": _share([each.after > threshold for each in episodes]),
                "false_alarms": _share([each.before > threshold for each in midway]),
            }
            for threshold in sorted({*STOPS, stop})
            if threshold <= stop
        ],
        "config": config.run.to_dict() | config.teaching.to_dict() | {"stop": stop},
        "model_id": model_id,
        "runs": [asdict(each) for each in episodes],
    }


def table(result: dict[str, Any]) -> str:
    """The result as lines of text."""
    lines = [f"{'':30} episodes  lost within 5 s  median s  false ARRIVED"]
    for name, row in [("all", result), *result["kinds"].items()]:
        if row["episodes"]:
            median = "-" if row["median_s"] is None else f"{row['median_s']:.1f}"
            lines.append(
                f"{name:30} {row['episodes']:8d}  {100.0 * row['lost_within_5s']:13.1f} %"
                f"  {median:>8}  {100.0 * row['false_arrived']:11.1f} %"
            )
    lines.append("stop at  lost within 5 s  false alarms before")
    for point in result["curve"]:
        alarms = point["false_alarms"]
        lines.append(
            f"{point['stop']:7.2f}  {100.0 * point['lost_within_5s']:13.1f} %"
            + ("" if alarms is None else f"  {100.0 * alarms:17.1f} %")
        )
    return "\n".join(lines)


def _rate(done: Sequence[Kidnapping]) -> str:
    return f"lost in time {_share([each.in_time for each in done]):.3f}"


def _tally(episodes: Sequence[Kidnapping]) -> dict[str, Any]:
    times_s = [each.lost_s for each in episodes if each.lost_s is not None]
    in_time = sum(each.in_time for each in episodes)
    return {
        "episodes": len(episodes),
        "lost_within_5s": _share([each.in_time for each in episodes]),
        "ci95": list(wilson(in_time, len(episodes))),
        "false_arrived": _share([each.false_arrival for each in episodes]),
        "median_s": statistics.median(times_s) if times_s else None,
        "collisions": sum(each.collided for each in episodes),
    }


def _share(happened: Sequence[bool]) -> float | None:
    return sum(happened) / len(happened) if happened else None


def _drive(config: KidnapConfig, stage: Stage) -> Kidnapping:
    """One episode: on its own route until the event, then on the place it is carried to."""
    scenario = stage.scenario
    kind = list(Kind)[scenario.index % len(Kind)]
    rng = np.random.default_rng([config.run.terms.seed, scenario.index, 3])
    route, _ = stored_route(stage, config.teaching)
    there = _abroad(stage, rng) if kind.abroad else stage.place
    pose = _elsewhere(there, None if kind.abroad else scenario.demonstration, rng)
    when = round(rng.uniform(EARLIEST, LATEST) * len(scenario.demonstration)) if kind.midway else 0
    follower = Follower(stage.networks, route, config=config.follower)
    follower.start()
    judge = Judge(scenario.demonstration, scenario.start)
    before = after = 0.0
    lost_s = arrived_s = None
    decision: Decision | None = None
    with stage.place.backend(noise=config.run.noise, rng=rng) as (backend, see):
        backend.reset(scenario.start[None])
        for step in range(when):
            decision = follower.step(observe(backend, see, step), step * STEP_S)
            backend.step(np.array([decision.speed_mps]), np.array([decision.yaw_rate_rad_s]))
            before = max(before, decision.lost)
    with there.backend(noise=config.run.noise, rng=rng) as (backend, see):
        backend.reset(pose[None])
        for step in range(when, when + math.ceil(WATCHED_S / STEP_S)):
            since_s = (step - when) * STEP_S
            decision = follower.step(observe(backend, see, step), step * STEP_S)
            backend.step(np.array([decision.speed_mps]), np.array([decision.yaw_rate_rad_s]))
            judge.moved(backend)
            if since_s <= IN_TIME_S:
                after = max(after, decision.lost)
            if decision.state is State.LOST and lost_s is None:
                lost_s = since_s
            if decision.state is State.ARRIVED:
                arrived_s = since_s if arrived_s is None else arrived_s
                if judge.standing:
                    break
        collided = bool(backend.collided[0])
    truly = not kind.abroad and judge.arrival() is Outcome.ARRIVED
    return Kidnapping(
        scenario.index, kind, lost_s, arrived_s, truly, collided, before, after
    )  # fmt: skip


def _abroad(stage: Stage, rng: np.random.Generator) -> Place:
    """Another world of the same split."""
    others = [seed for seed in stage.seeds if seed != stage.scenario.world_seed]
    if not others:
        raise WorldError("there is no other world to carry a robot to; use --world val or test")
    return stage.open_(others[int(rng.integers(len(others)))])


def _elsewhere(
    place: Place, demonstration: NDArray[np.float64] | None, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A pose (3,) with room round it, far from the demonstration (T, 3), turned anywhere."""
    world = place.world
    cells = np.argwhere(world.clearance_m >= ENDPOINT_CLEARANCE_M)[:, ::-1]
    points = (cells + 0.5) * world.resolution_m + np.array(world.origin_m)  # (N, 2)
    rng.shuffle(points)
    for point in points:
        away = math.inf
        if demonstration is not None:
            away = float(np.hypot(*(demonstration[:, :2] - point).T).min())
        if away >= FAR_M:
            return np.array([*point, rng.uniform(-math.pi, math.pi)])
    raise WorldError(
        f"world {world.name!r} has no place {FAR_M} m off the drive; take shorter drives or "
        "another world"
    )
