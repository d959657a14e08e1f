"""Many episodes in parallel processes: drives demonstrated, taught, stored, read and repeated."""

import functools
import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.errors import ConfigError
from cbe_bench.episode import Outcome, Ride, film, ride
from cbe_bench.memory import Memory
from cbe_bench.place import BACKENDS, Bin, Place, is_scene, world_seeds
from cbe_bench.scenario import BIN_MARGIN_SAMPLES, GROUP, Scenario, Terms, scenarios
from cbe_bench.tally import Record, summary
from cbe_runtime import routefile
from cbe_runtime.follower import Follower
from cbe_runtime.networks import PACKAGED_MODELS, Networks
from cbe_runtime.route import Route

FARTHEST_M = 1.0
"""Clearances beyond count as this; pybullet looks no farther."""

Teach = Callable[[Networks, Sequence[NDArray[np.uint8]]], Route]
"""From a drive's views (64, 64, 3), one a step, to its route."""


@dataclass(frozen=True, slots=True)
class RunConfig:
    """What episodes are run and under which conditions.

    `world_seeds` of None takes the whole split.
    """

    terms: Terms
    episodes: int = 500
    world_seeds: range | None = None
    backend: str = "column"
    noise: float = 0.0
    model: Path = PACKAGED_MODELS
    jobs: int = 0  # 0 takes a process a core
    memory: Memory = Memory.FULL

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        terms = self.terms
        least, found = 2 * BIN_MARGIN_SAMPLES + 1 if terms.obstacles else 1, terms.drives
        if self.episodes < 1 or found.shortest_steps < least or terms.seed < 0:
            raise ConfigError(
                f"at least 1 episode of at least {least} steps and a seed of 0 or more are "
                f"needed; found {self.episodes}, {found} and {terms.seed}"
            )
        if min(terms.jitter_scale, terms.obstacles, self.noise, self.jobs) < 0:
            raise ConfigError(
                f"jitter scale {terms.jitter_scale}, obstacles {terms.obstacles}, noise "
                f"{self.noise} and jobs {self.jobs} cannot be negative"
            )
        if self.backend not in BACKENDS:
            raise ConfigError(f"unknown backend {self.backend!r}; known: {', '.join(BACKENDS)}")
        if is_scene(terms.world) and self.backend == "column":
            raise ConfigError(f"{terms.world} is a mesh scene: add --backend bullet")
        if self.backend == "bullet" and self.noise > 0.0:
            raise ConfigError("actuation noise is the column backend's: leave out --noise")

    def to_dict(self) -> dict[str, Any]:
        """What the result's `config` holds; all options that change it."""
        terms, seeds = asdict(self.terms), self.world_seeds
        drives: dict[str, Any] = terms.pop("drives")
        here = {
            "episodes": self.episodes,
            "world_seeds": None if seeds is None else f"{seeds.start}:{seeds.stop}",
            "backend": self.backend,
            "noise": self.noise,
            "memory": self.memory.value,
        }
        return drives | terms | here


@dataclass(frozen=True, slots=True)
class Stored:
    """What a drive of so many steps was stored in; `size_bytes` is the whole file's."""

    length_m: float
    steps: int
    segments: int
    attractors: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Trace:
    """One episode: its result and what a picture shows, driven and demonstrated poses (T, 3)."""

    record: Record
    stored: Stored
    demonstration: NDArray[np.float64]
    poses: NDArray[np.float64]
    bins: tuple[Bin, ...]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A finished run: its summary as `--json` holds it, and every episode's trace."""

    summary: dict[str, Any]
    traces: list[Trace]


def evaluate(config: RunConfig, teach: Teach, label: str) -> Evaluation:
    """Drive all episodes, with a progress bar on stderr.

    Raises:
        CbeError: the model, the world or an option cannot be used.
    """
    from joblib import Parallel, delayed
    from tqdm import tqdm

    model_id = Networks.load(config.model).model_id  # refused here rather than in every process
    seeds = world_seeds(config.terms.world, config.world_seeds)
    groups = math.ceil(config.episodes / GROUP)
    jobs = min(config.jobs or os.cpu_count() or 1, groups)
    tasks = (
        delayed(_drive_group)(config, teach, seeds, g, min(GROUP, config.episodes - g * GROUP))
        for g in range(groups)
    )
    traces: list[Trace] = []
    with tqdm(total=config.episodes, desc=label, unit="ep") as bar:
        for done in Parallel(n_jobs=jobs, return_as="generator_unordered")(tasks):
            traces += done
            bar.update(len(done))
            arrived = sum(trace.record.success for trace in traces)
            bar.set_postfix_str(f"success {arrived / len(traces):.3f}")
    traces.sort(key=lambda trace: trace.record.index)
    records = [trace.record for trace in traces]
    return Evaluation(summary(records, config.to_dict(), model_id), traces)


def _drive_group(
    config: RunConfig, teach: Teach, seeds: Sequence[int], group: int, count: int
) -> list[Trace]:
    """One process's task: the first `count` episodes of a group."""
    use_one_thread()
    networks = _networks(config.model)
    with ExitStack() as places:

        def open_(world_seed: int) -> Place:
            place = Place(config.terms.world, world_seed, config.backend)
            places.callback(place.close)
            return place

        return [
            _drive(networks, config, teach, place, scenario)
            for place, scenario in scenarios(config.terms, group, count, seeds, open_)
        ]


def _drive(
    networks: Networks, config: RunConfig, teach: Teach, place: Place, scenario: Scenario
) -> Trace:
    """Teach the scenario's demonstration and repeat it from the bytes of its route file."""
    with place.backend() as (backend, see):
        data = routefile.dump(teach(networks, film(backend, see, scenario.demonstration)))
    route = routefile.parse(data)
    stored = Stored(
        scenario.length_m, route.steps, len(route.segments), len(route.attractors), len(data)
    )
    follower = Follower(networks, config.memory.of(route))
    rng = np.random.default_rng([config.terms.seed, scenario.index, 1])
    with place.backend(noise=config.noise, rng=rng, bins=scenario.bins) as (backend, see):
        driven = ride(follower, backend, see, scenario.demonstration, scenario.start)
    return Trace(
        _record(scenario, driven), stored, scenario.demonstration, driven.poses, scenario.bins
    )


@functools.cache
def _networks(folder: Path) -> Networks:
    return Networks.load(folder)


def use_one_thread() -> None:
    """Processes share the cores already; threads in each would only wait for one another."""
    import cv2
    import numba

    numba.set_num_threads(1)
    cv2.setNumThreads(1)


def _record(scenario: Scenario, driven: Ride) -> Record:
    success = driven.outcome is Outcome.ARRIVED
    shortest = scenario.length_m
    x, y, yaw = scenario.demonstration[-1]
    return Record(
        index=scenario.index,
        world_seed=scenario.world_seed,
        goal=(float(x), float(y), float(yaw)),
        outcome=driven.outcome,
        success=success,
        success_paper=driven.reached,
        spl=success * shortest / max(shortest, driven.length_m, 1e-9),
        final_error_m=driven.final_error_m,
        final_error_deg=math.degrees(driven.final_error_rad),
        min_clearance_m=min(driven.min_clearance_m, FARTHEST_M),
        steps=driven.steps,
    )
