"""Faults in closed-loop drives: what each costs in success, collisions and time to stand."""

import functools
import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from cbe_bench import single
from cbe_bench.episode import Outcome
from cbe_bench.evaluation import RunConfig, Stage, each_episode, stored_route
from cbe_bench.faultlist import NONE, Fault
from cbe_bench.faultride import FaultyRide, ride
from cbe_runtime.follower import Follower
from cbe_runtime.networks import Networks


@dataclass(frozen=True, slots=True)
class FaultsConfig:
    """Which faults are injected into which episodes."""

    run: RunConfig
    faults: tuple[Fault, ...]


@dataclass(frozen=True, slots=True)
class Episode:
    """One drive without any fault, and the same under each in turn."""

    without: FaultyRide
    rides: tuple[FaultyRide, ...]


def measure(config: FaultsConfig) -> dict[str, Any]:
    """Drive every episode once without and once under each fault; what `--json` holds.

    A collision counts against a fault (`collisions`) where the same episode without it has none;
    `collisions_without` are those that happen without it. `worst_stop_s` is the longest time from
    the onset of a fault that must stop the robot to standing, `worst_zero_s` to a commanded zero;
    -1 where that did not come about, null where it need not.

    Raises:
        CbeError: the model, the world or an option cannot be used.
    """
    model_id = Networks.load(config.run.model).model_id
    drive = functools.partial(_drive, config)
    episodes = each_episode(config.run, drive, "episodes")
    without = [episode.without for episode in episodes]
    return {
        "faults": [
            _tally(fault, [episode.rides[number] for episode in episodes], without)
            for number, fault in enumerate(config.faults)
        ],
        "without": {
            "episodes": len(without),
            "success": _success(without),
            "collisions": sum(map(_collided, without)),
        },
        "config": config.run.to_dict(),
        "model_id": model_id,
    }


def table(result: dict[str, Any]) -> str:
    """The result as lines of text."""
    without = result["without"]
    lines = [
        "fault            level               success  collisions  zero s  stand s",
        f"{'none':36} {without['success']:7.3f}  {without['collisions']:10d}",
    ]
    for row in result["faults"]:
        times = "".join(
            "        " if row[key] is None else f"  {row[key]:6.2f}"
            for key in ("worst_zero_s", "worst_stop_s")
        )
        lines.append(
            f"{row['fault']:16} {row['level']:19} {row['success']:7.3f}  {row['collisions']:10d}"
            f"{times}"
        )
    return "\n".join(lines)


def _drive(config: FaultsConfig, stage: Stage) -> Episode:
    """Teach the stage's demonstration, and repeat it under each fault."""
    run, scenario = config.run, stage.scenario
    seed = run.terms.seed
    route, _ = stored_route(stage, single.teach)

    def one(fault: Fault) -> FaultyRide:
        slip = np.random.default_rng([seed, scenario.index, 1])
        # Alike for all faults: each then strikes at the same moment.
        chance = np.random.default_rng([seed, scenario.index, 2])
        follower = Follower(stage.networks, route)
        with stage.place.backend(noise=run.noise, rng=slip, bins=scenario.bins) as (backend, see):
            return ride(
                follower, backend, see, scenario.demonstration, scenario.start, fault, chance
            )

    with _silenced(logging.getLogger("cbe_runtime")):  # faults are what it is to meet
        return Episode(one(NONE), tuple(map(one, config.faults)))


@contextmanager
def _silenced(logger: logging.Logger) -> Iterator[None]:
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _tally(fault: Fault, rides: list[FaultyRide], without: list[FaultyRide]) -> dict[str, Any]:
    pairs = zip(rides, without, strict=True)
    return {
        "fault": fault.name,
        "level": fault.level,
        "episodes": len(rides),
        "success": _success(rides),
        "collisions": sum(_collided(one) and not _collided(other) for one, other in pairs),
        "collisions_without": sum(map(_collided, without)),
        "worst_zero_s": _worst([one.zero_s for one in rides]) if fault.must_stop else None,
        "worst_stop_s": _worst([one.stop_s for one in rides]) if fault.must_stop else None,
        "outcomes": [one.outcome.value for one in rides],
    }


def _collided(one: FaultyRide) -> bool:
    return one.outcome is Outcome.COLLISION


def _success(rides: list[FaultyRide]) -> float:
    return sum(one.outcome is Outcome.ARRIVED for one in rides) / len(rides)


def _worst(times_s: list[float | None]) -> float | None:
    """The longest of those struck while moving; -1 where one never came to it."""
    struck = [time_s for time_s in times_s if time_s is not None]
    if not struck:
        return None
    return round(max(struck), 3) if math.isfinite(max(struck)) else -1.0
