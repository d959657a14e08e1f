"""Single behaviors, closed loop: many episodes in parallel processes (paper, Sec. IV-B)."""

import functools
import math
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA
from cbe.errors import ConfigError
from cbe_bench.episode import Outcome, Ride, film, ride
from cbe_bench.memory import Memory
from cbe_bench.place import BACKENDS, Bin, Place, is_scene, world_seeds
from cbe_bench.scenario import BIN_MARGIN_SAMPLES, GROUP, Scenario, Terms, scenarios
from cbe_bench.tally import Record, summary
from cbe_runtime.follower import Follower
from cbe_runtime.networks import PACKAGED_MODELS, Networks
from cbe_runtime.route import Route
from cbe_runtime.teach import Teacher

FARTHEST_M = 1.0
"""Clearances beyond count as this; pybullet looks no farther."""


@dataclass(frozen=True, slots=True)
class SingleConfig:
    """A run of `cbe-bench single`; `world_seeds` of None takes the whole split."""

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
        least = 2 * BIN_MARGIN_SAMPLES + 1 if terms.obstacle_offset_m is not None else 1
        if self.episodes < 1 or terms.steps < least or terms.seed < 0:
            raise ConfigError(
                f"at least 1 episode of at least {least} steps and a seed of 0 or more are "
                f"needed; found {self.episodes}, {terms.steps} and {terms.seed}"
            )
        if terms.jitter_scale < 0.0 or self.noise < 0.0 or self.jobs < 0:
            raise ConfigError(
                f"jitter scale {terms.jitter_scale}, noise {self.noise} and jobs {self.jobs} "
                "cannot be negative"
            )
        if self.backend not in BACKENDS:
            raise ConfigError(f"unknown backend {self.backend!r}; known: {', '.join(BACKENDS)}")
        if is_scene(terms.world) and self.backend == "column":
            raise ConfigError(f"{terms.world} is a mesh scene: add --backend bullet")
        if self.backend == "bullet" and self.noise > 0.0:
            raise ConfigError("actuation noise is the column backend's: leave out --noise")

    def to_dict(self) -> dict[str, Any]:
        """What the result's `config` holds; all options that change it."""
        seeds = self.world_seeds
        return asdict(self.terms) | {
            "episodes": self.episodes,
            "world_seeds": None if seeds is None else f"{seeds.start}:{seeds.stop}",
            "backend": self.backend,
            "noise": self.noise,
            "memory": self.memory.value,
        }


@dataclass(frozen=True, slots=True)
class Trace:
    """What a picture of an episode shows: driven and demonstrated poses (T, 3), the bin."""

    record: Record
    demonstration: NDArray[np.float64]
    poses: NDArray[np.float64]
    bin_: Bin | None


@dataclass(frozen=True, slots=True)
class Single:
    """A finished run: its summary as `--json` holds it, and every episode's trace."""

    summary: dict[str, Any]
    traces: list[Trace]


def run(config: SingleConfig, label: str = "episodes") -> Single:
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
        delayed(_drive_group)(config, seeds, g, min(GROUP, config.episodes - g * GROUP))
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
    return Single(summary(records, config.to_dict(), model_id), traces)


def drive(networks: Networks, config: SingleConfig, place: Place, scenario: Scenario) -> Ride:
    """Teach the scenario's demonstration as one behavior and repeat it."""
    with place.backend() as (backend, see):
        route = teach(networks, film(backend, see, scenario.demonstration))
    follower = Follower(networks, config.memory.of(route))
    rng = np.random.default_rng([config.terms.seed, scenario.index, 1])
    with place.backend(noise=config.noise, rng=rng, bin_=scenario.bin_) as (backend, see):
        return ride(follower, backend, see, scenario.demonstration, scenario.start)


def teach(networks: Networks, views: Sequence[NDArray[np.uint8]]) -> Route:
    """The route of a drive's views (64, 64, 3), one a step, as a single behavior."""
    steps = len(views) - 1
    # One more than the drive, for the teacher rounds down to whole network periods.
    teacher = Teacher(networks, MODEL_CAMERA, segment_steps=steps + 1, total_steps=steps)
    for view in views:
        teacher.feed(view)
    return teacher.finish()


def _drive_group(config: SingleConfig, seeds: Sequence[int], group: int, count: int) -> list[Trace]:
    """One process's task: the first `count` episodes of a group."""
    use_one_thread()
    networks = _networks(config.model)
    with ExitStack() as places:

        def open_(world_seed: int) -> Place:
            place = Place(config.terms.world, world_seed, config.backend)
            places.callback(place.close)
            return place

        return [
            _trace(scenario, drive(networks, config, place, scenario))
            for place, scenario in scenarios(config.terms, group, count, seeds, open_)
        ]


@functools.cache
def _networks(folder: Path) -> Networks:
    return Networks.load(folder)


def use_one_thread() -> None:
    """Processes share the cores already; threads in each would only wait for one another."""
    import cv2
    import numba

    numba.set_num_threads(1)
    cv2.setNumThreads(1)


def _trace(scenario: Scenario, driven: Ride) -> Trace:
    success = driven.outcome is Outcome.ARRIVED
    shortest = scenario.length_m
    x, y, yaw = scenario.demonstration[-1]
    record = Record(
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
    return Trace(record, scenario.demonstration, driven.poses, scenario.bin_)
