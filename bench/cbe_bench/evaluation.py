"""Many episodes in parallel processes: drives demonstrated, taught, stored, read and repeated."""

import functools
import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cbe.camera import CameraModel, Preprocessor, coverage
from cbe.errors import ConfigError
from cbe_bench.episode import Outcome, Ride, film, ride
from cbe_bench.memory import Memory
from cbe_bench.place import BACKENDS, Bin, Place, is_scene, world_seeds
from cbe_bench.scenario import BIN_MARGIN_SAMPLES, GROUP, Scenario, Terms, scenarios
from cbe_bench.tally import Record, summary
from cbe_runtime import routefile
from cbe_runtime.follower import Follower
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.networks import PACKAGED_MODELS, Networks
from cbe_runtime.route import Route

FARTHEST_M = 1.0
"""Clearances beyond count as this; pybullet looks no farther."""

T = TypeVar("T")

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
    camera: CameraModel | None = None  # None sees just the networks' view

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
        if self.camera is not None:
            Preprocessor(self.camera)  # refused here rather than in every process
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
            "camera": None if self.camera is None else str(coverage(self.camera)),
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
    model_id = Networks.load(config.model).model_id  # refused here rather than in every process

    def rate(traces: Sequence[Trace]) -> str:
        return f"success {sum(trace.record.success for trace in traces) / len(traces):.3f}"

    drive = functools.partial(_drive, config, teach)
    traces = each_episode(config, drive, label, rate)
    records = [trace.record for trace in traces]
    return Evaluation(summary(records, config.to_dict(), model_id), traces)


@dataclass(frozen=True, slots=True)
class Stage:
    """Where an episode takes place; `open_` opens another of its world's split by its seed.

    What is opened is closed after the group of episodes that share a stage's worlds.
    """

    networks: Networks
    place: Place
    scenario: Scenario
    seeds: Sequence[int]
    open_: Callable[[int], Place]


def each_episode(
    config: RunConfig,
    drive: Callable[[Stage], T],
    label: str,
    note: Callable[[Sequence[T]], str] = lambda done: "",
) -> list[T]:
    """What `drive` makes of each episode, in their order; in parallel, with a progress bar.

    Raises:
        CbeError: the world or an option cannot be used.
    """
    from joblib import Parallel, delayed
    from tqdm import tqdm

    seeds = world_seeds(config.terms.world, config.world_seeds)
    groups = math.ceil(config.episodes / GROUP)
    jobs = min(config.jobs or os.cpu_count() or 1, groups)
    tasks = (
        delayed(_drive_group)(config, drive, seeds, g, min(GROUP, config.episodes - g * GROUP))
        for g in range(groups)
    )
    found: list[tuple[int, T]] = []
    with tqdm(total=config.episodes, desc=label, unit="ep") as bar:
        for done in Parallel(n_jobs=jobs, return_as="generator_unordered")(tasks):
            found += done
            bar.update(len(done))
            bar.set_postfix_str(note([each for _, each in found]))
    return [each for _, each in sorted(found, key=lambda numbered: numbered[0])]


def _drive_group(
    config: RunConfig, drive: Callable[[Stage], T], seeds: Sequence[int], group: int, count: int
) -> list[tuple[int, T]]:
    """One process's task: the first `count` episodes of a group, with their numbers."""
    use_one_thread()
    networks = _networks(config.model)
    with ExitStack() as places:

        def open_(world_seed: int) -> Place:
            place = Place(config.terms.world, world_seed, config.backend, config.camera)
            places.callback(place.close)
            return place

        return [
            (scenario.index, drive(Stage(networks, place, scenario, seeds, open_)))
            for place, scenario in scenarios(config.terms, group, count, seeds, open_)
        ]


def stored_route(stage: Stage, teach: Teach) -> tuple[Route, int]:
    """The route of the stage's drive as its file holds it, and that file's bytes."""
    with stage.place.backend() as (backend, see):
        # Rendering meshes takes most of the time, and the teacher looks at these views alone.
        views = film(backend, see, stage.scenario.demonstration, stage.networks.network_period)
    data = routefile.dump(teach(stage.networks, views))
    return routefile.parse(data), len(data)


def _drive(config: RunConfig, teach: Teach, stage: Stage) -> Trace:
    """Teach the scenario's demonstration and repeat it from the bytes of its route file."""
    networks, place, scenario = stage.networks, stage.place, stage.scenario
    route, size_bytes = stored_route(stage, teach)
    stored = Stored(
        scenario.length_m, route.steps, len(route.segments), len(route.attractors), size_bytes
    )
    follower = Follower(networks, config.memory.of(route), config=_follower_config(config.memory))
    rng = np.random.default_rng([config.terms.seed, scenario.index, 1])
    with place.backend(noise=config.noise, rng=rng, bins=scenario.bins) as (backend, see):
        driven = ride(follower, backend, see, scenario.demonstration, scenario.start)
    return Trace(
        _record(scenario, driven), stored, scenario.demonstration, driven.poses, scenario.bins
    )


def _follower_config(memory: Memory) -> FollowerConfig:
    """One that is never LOST where parts are missing: what they are worth is asked, not noticed."""
    usual = FollowerConfig()
    if memory is Memory.FULL:
        return usual
    never_lost = replace(
        usual.lost, stop=1.0, doubt_rest=1.0, apart_rest_m=math.inf, nearer_rest_m=-math.inf
    )
    return replace(usual, lost=never_lost)


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
