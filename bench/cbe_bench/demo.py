"""`make demo`: teach a drive once in simulation and repeat it, every part a process of its own."""

from __future__ import annotations

import argparse
import importlib.util
import math
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from cbe.errors import CbeError, LinkError
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe_bench.demo_course import Course, choose
from cbe_bench.demo_processes import Child, Crew, free_port
from cbe_bench.demo_report import Report
from cbe_bench.demo_stage import DemoConfig, Stage
from cbe_bench.demo_witness import Witness
from cbe_hil_sim.generate import TEST_HOUSES, generate
from cbe_runtime import routefile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from cbe_hil_sim.world import World

SIM_START_S = 60.0


def main(arguments: list[str] | None = None) -> int:
    """Run the demonstration; 0 if the robot truly arrived, 1 if not, 2 for what was refused."""
    options = _parser().parse_args(arguments)
    config = DemoConfig(
        options.seed, options.scene, options.obstacle, options.fast, options.out, options.model
    )
    if config.seed not in range(len(TEST_HOUSES)):
        sys.stderr.write(f"demo: --seed must be 0 to {len(TEST_HOUSES) - 1}; found {config.seed}\n")
        return 2
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return 0 if run(config) else 1
    except CbeError as error:
        sys.stderr.write(f"demo: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("demo: interrupted\n")
        return 130


def run(config: DemoConfig) -> bool:
    """Teach, repeat, report; whether the robot truly arrived.

    Raises:
        CbeError: a part refused to work.
    """
    began_s = time.monotonic()
    logs = config.folder / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    world = _world(config)
    course = choose(world, config.seed, min_doors=0 if config.scene else 2)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Crew(logs) as crew:
        sim = crew.start("cbe-sim", "--listen", endpoint, *_sim_options(config, course))
        with _step("1/5 simulator") as advance:
            link = _connected(endpoint, sim, advance)
        with link, Witness(link) as witness:
            stage = Stage(config, crew, link, witness, sim, endpoint)
            with _step("2/5 demonstration") as advance:
                drive = stage.demonstrate(course, advance)
            with _step("3/5 teaching") as advance:
                route_path = stage.teach(drive, advance)
            with _step("4/5 repetition") as advance:
                repetition = stage.repeat(world, drive, route_path, advance)
            link.call("shutdown")
            sim.wait(SIM_START_S)
    route = routefile.load(route_path)
    report = Report(drive, route, route_path.stat().st_size, repetition)
    with _step("5/5 pictures") as advance:
        drawn = iter(range(1, 4))
        report.draw(config.folder, world, lambda: advance(next(drawn) / 3))
    sys.stdout.write(f"\n{report.table()}  {'whole time':<18} {time.monotonic() - began_s:.0f} s\n")
    sys.stdout.write(f"pictures and recordings are in {config.folder}/\n")
    return report.succeeded


def _world(config: DemoConfig) -> World:
    """What to plan in: an unseen generated house, or a scene's free space."""
    if config.scene is None:
        return generate(TEST_HOUSES[config.seed])
    from cbe_hil_sim.meshscene import load_scene

    return load_scene(config.scene).planning


def _sim_options(config: DemoConfig, course: Course) -> list[str]:
    # From the drive's own start: what is recorded before it shows the same place.
    options = ["--start=" + ",".join(f"{value:.6f}" for value in course.start)]
    if config.scene is None:
        options += ["--world", str(TEST_HOUSES[config.seed])]
    else:
        options += ["--scene", str(config.scene)]
    if importlib.util.find_spec("pybullet") is None:
        sys.stdout.write("pybullet is not installed: showing the column world, without physics\n")
        options += ["--backend", "column"]
    return [*options, "--lockstep"] if config.fast else options


def _connected(endpoint: str, sim: Child, advance: Callable[[float], None]) -> Link:
    """A link to the simulator, once it has loaded its world."""
    began_s = time.monotonic()
    while True:
        advance(1.0 - math.exp(-(time.monotonic() - began_s) / 4.0))  # usually some seconds
        sim.require_running()
        try:
            return Link.open(LinkConfig(connect=(endpoint,), open_timeout_s=0.5))
        except LinkError:
            if time.monotonic() - began_s > SIM_START_S:
                raise


@contextmanager
def _step(title: str) -> Iterator[Callable[[float], None]]:
    """A named step; yields what moves its bar to a share of 0 to 1, shown after two seconds."""
    began_s = time.monotonic()
    layout = "{desc:<20} |{bar:30}| {percentage:3.0f} % {elapsed}"
    with tqdm(
        total=1.0, desc=title, delay=2.0, leave=False, bar_format=layout, disable=None
    ) as bar:
        yield lambda share: _move(bar, share)
    sys.stdout.write(f"{title:<20} {time.monotonic() - began_s:5.1f} s\n")
    sys.stdout.flush()


def _move(bar: tqdm[Any], share: float) -> None:
    bar.update(min(share, 1.0) - bar.n)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m cbe_bench.demo",
        description="Teach a drive once in simulation, then repeat it. Exit code 0 if it arrived.",
    )
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="house and drive (default %(default)s)"
    )
    parser.add_argument("--scene", type=Path, metavar="DIR", help="a mesh scene in place of it")
    parser.add_argument("--obstacle", action="store_true", help="put a bin on the way")
    parser.add_argument(
        "--fast", action="store_true", help="repeat in lock-step, faster than real time"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder (%(default)s)"
    )
    parser.add_argument(
        "--model", type=Path, metavar="DIR", help="the ONNX files (default: the shipped ones)"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
