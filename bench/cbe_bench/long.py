"""Routes of many kilometres: file, load time, memory and tick against those of a short one."""

import itertools
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA
from cbe.robot import STEP_S, Robot
from cbe_bench.demo_processes import rss_mib
from cbe_runtime import routefile
from cbe_runtime.follower import Follower
from cbe_runtime.networks import Networks
from cbe_runtime.observation import Frame, Observation, Scan
from cbe_runtime.route import Precision
from cbe_runtime.teach import Teacher

Views = Sequence[NDArray[np.uint8]]

SHORT_M = 20.0
FILMED_STEPS = 400
ROUNDS, LOADS, TICKS = 3, 5, 400


@dataclass(frozen=True, slots=True)
class Carried:
    """A route in a process of its own: seconds to load, MiB that route and follower take, ticks."""

    load_s: float
    memory_mib: float
    tick_ms: float


def measure(
    lengths_m: Sequence[float], model: Path, precision: Precision, say: Callable[[str], None]
) -> dict[str, Any]:
    """Teach routes of so many metres, streaming, and carry each; what `--json` holds.

    Each length is carried `ROUNDS` times, in turn; figures are medians with their range.

    Raises:
        CbeError: the model cannot be used.
    """
    networks = Networks.load(model)
    views = _filmed()
    lengths = sorted({SHORT_M, *lengths_m})
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for length_m in lengths:
            say(f"teaching {length_m:g} m")
            rows.append(_teach(networks, views, length_m, precision, Path(folder)))
        carried: list[list[Carried]] = [[] for _ in lengths]
        say(f"loading and driving, {ROUNDS} rounds")
        for _, (index, length_m) in itertools.product(range(ROUNDS), enumerate(lengths)):
            path = _path(Path(folder), length_m)
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                carried[index].append(pool.submit(_carry, path, model, views[:TICKS]).result())
    for row, each in zip(rows, carried, strict=True):
        for name in asdict(each[0]):
            values = [getattr(one, name) for one in each]
            row |= {name: statistics.median(values), f"{name}_range": [min(values), max(values)]}
    return {"lengths": rows, "model_id": networks.model_id}


def table(result: dict[str, Any]) -> str:
    """The result as lines of text."""
    lines = ["    length    bytes  a metre  teaching grew  load s  memory MiB  tick ms (range)"]
    for row in result["lengths"]:
        low, high = row["tick_ms_range"]
        lines.append(
            f"{row['length_m']:8g} m {row['bytes']:8d} {row['bytes'] / row['length_m']:8.1f}"
            f" {row['teaching_mib']:10.1f} MiB {row['load_s']:7.4f} {row['memory_mib']:11.1f}"
            f" {row['tick_ms']:8.2f} ({low:.2f} to {high:.2f})"
        )
    return "\n".join(lines)


def _filmed() -> Views:
    """Views (64, 64, 3) of a drive to and fro, one a step, without end when repeated."""
    from cbe_bench.drives import Pieces
    from cbe_bench.episode import film
    from cbe_bench.place import Place, world_seeds
    from cbe_bench.scenario import Terms, scenarios

    opened: list[Place] = []

    def open_(seed: int) -> Place:
        opened.append(Place("test", seed))
        return opened[-1]

    terms = Terms("test", Pieces(FILMED_STEPS), 0)
    ((place, scenario),) = scenarios(terms, 0, 1, world_seeds("test", None), open_)
    with place.backend() as (backend, see):
        views = film(backend, see, scenario.demonstration)
    return [*views, *views[-2:0:-1]]


def _path(folder: Path, length_m: float) -> Path:
    return folder / f"{length_m:g}m.msgpack"


def _teach(
    networks: Networks, views: Views, length_m: float, precision: Precision, folder: Path
) -> dict[str, Any]:
    """Stream a drive of that length into a route file."""
    steps = round(length_m / (STEP_S * Robot().max_speed_mps))
    teacher = Teacher(networks, MODEL_CAMERA, total_steps=steps, precision=precision)
    before_mib = rss_mib(os.getpid())
    for view in _driven(views, steps + 1):
        teacher.feed(view)
    grown_mib = rss_mib(os.getpid()) - before_mib
    route = teacher.finish()
    size = routefile.save(route, _path(folder, length_m))
    return {
        "length_m": length_m,
        "segments": len(route.segments),
        "bytes": size,
        "teaching_mib": grown_mib,
    }


def _driven(views: Views, count: int) -> Iterator[NDArray[np.uint8]]:
    return itertools.islice(itertools.cycle(views), count)


def _carry(path: Path, model: Path, views: Views) -> Carried:
    """Load and begin a route, in a process that has nothing else in it."""
    networks, robot = Networks.load(model), Robot()
    scan_m = np.full(robot.scan_rays, 3.0)
    before_mib = rss_mib(os.getpid())
    loads_s = []
    for _ in range(LOADS):
        began_s = time.perf_counter()
        route = routefile.load(path)
        loads_s.append(time.perf_counter() - began_s)
    follower = Follower(networks, route)
    follower.start()
    ticks_s = []
    for step, view in enumerate(views):
        now_s, stamp_ns = step * STEP_S, round(step * STEP_S * 1e9)
        seen = Observation(Frame(view, now_s, stamp_ns), Scan(scan_m, now_s, stamp_ns))
        began_s = time.perf_counter()
        ticked = follower.step(seen, now_s).ticked
        if ticked:
            ticks_s.append(time.perf_counter() - began_s)
    grown_mib = rss_mib(os.getpid()) - before_mib
    return Carried(statistics.median(loads_s), grown_mib, 1e3 * statistics.median(ticks_s))
