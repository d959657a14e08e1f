"""`make demo`: teach a drive once in simulation and repeat it, every part a process of its own."""

from __future__ import annotations

import argparse
import importlib.util
import math
import signal
import sys
import time
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from cbe.errors import CbeError, LinkError
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.robot import STEP_S, Robot
from cbe_bench.demo_course import Course, bin_place, choose, jittered
from cbe_bench.demo_processes import Child, Crew, OverdueError, ProcessError, free_port
from cbe_bench.demo_report import ARRIVED, Drive, Repetition, Report
from cbe_bench.demo_witness import Witness, along
from cbe_hil_sim.generate import TEST_SEEDS, generate
from cbe_runtime import routefile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from cbe_hil_sim.world import World

SIM_START_S, DRIVE_S, TEACH_S = 60.0, 90.0, 60.0  # deadlines, far beyond what is usual
RECORDER_START_S = 15.0
REPEAT_FACTOR, REPEAT_EXTRA_S = 1.6, 15.0  # times the demonstration's own time
OFF_ROUTE_M = 1.5
STUCK_M, STUCK_STEPS = 0.1, 120
EXIT_STOPPED = 3
POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """What to show; `model` None means the shipped one."""

    seed: int
    scene: Path | None
    obstacle: bool
    fast: bool
    folder: Path
    model: Path | None

    @property
    def model_options(self) -> tuple[str, ...]:
        """Command-line options that choose the model."""
        return () if self.model is None else ("--model", str(self.model))


def main(arguments: list[str] | None = None) -> int:
    """Run the demonstration; 0 if the robot truly arrived, 1 if not, 2 for what was refused."""
    options = _parser().parse_args(arguments)
    config = DemoConfig(
        options.seed, options.scene, options.obstacle, options.fast, options.out, options.model
    )
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
            stage = _Stage(config, crew, link, witness, sim, endpoint)
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


class _Stage:
    """The acts, in order, on one simulator."""

    def __init__(
        self,
        config: DemoConfig,
        crew: Crew,
        link: Link,
        witness: Witness,
        sim: Child,
        endpoint: str,
    ) -> None:
        self._config = config
        self._crew = crew
        self._link = link
        self._witness = witness
        self._sim = sim
        self._endpoint = endpoint

    def demonstrate(self, course: Course, advance: Callable[[float], None]) -> Drive:
        """Let the simulator's demonstrator drive the course while it is recorded."""
        recording = self._config.folder / "drive.mcap"
        recorder = self._record(recording, "record-drive")
        self._witness.restart()
        request = {"path": course.path.tolist()}
        driving = _in_background(lambda: self._link.call("drive", request, timeout_s=DRIVE_S))
        expected = course.length_m / Robot().max_speed_mps / STEP_S

        def driven() -> bool:
            advance(len(self._witness.truths) / expected)
            return driving.done()

        self._until(driven, DRIVE_S, "the demonstration to end", recorder)
        reply = driving.result()
        self._finish(recorder)
        if not reply["arrived"]:
            raise ProcessError(
                f"the demonstrator did not arrive ({reply['reason']}); choose another seed"
            )
        return Drive(np.array(reply["poses"]), reply["stamps_ns"][0], recording, course.doors)

    def teach(self, drive: Drive, advance: Callable[[float], None]) -> Path:
        """Turn the recording into a route."""
        route = self._config.folder / "route.msgpack"
        teacher = self._crew.start(
            "cbe-teach", str(drive.recording), "-o", str(route), *self._config.model_options
        )
        usual_s = 1.0 + 0.01 * len(drive.poses)
        began_s = time.monotonic()

        def taught() -> bool:
            advance(min((time.monotonic() - began_s) / usual_s, 0.99))
            return teacher.returncode is not None

        self._until(taught, TEACH_S, "cbe-teach to end")
        if teacher.returncode != 0:
            raise ProcessError(f"cbe-teach refused:\n{teacher.tail()}")
        return route

    def repeat(
        self, world: World, drive: Drive, route: Path, advance: Callable[[float], None]
    ) -> Repetition:
        """Put the robot back near the start and let the runtime drive."""
        config, obstacle_m = self._config, None
        if config.obstacle:
            place = bin_place(world, drive.poses, config.seed)
            self._link.call("obstacle", {"pose": place.tolist()}, timeout_s=30.0)
            obstacle_m = (float(place[0]), float(place[1]))
        start = jittered(world, drive.poses[0], config.seed)
        self._link.call("reset", {"pose": start.tolist()}, timeout_s=30.0)
        recording = config.folder / "repeat.mcap"
        recorder = self._record(recording, "record-repeat")
        self._witness.restart()
        clock = ("--clock", "sim") if config.fast else ()
        runtime = self._crew.start(
            "cbe-runtime", "--memory", str(route), "--connect", self._endpoint,
            "--exit-when-done", *clock, *config.model_options,
        )  # fmt: skip
        ended = self._watch(runtime, drive, advance)
        self._finish(recorder)
        truths = self._witness.truths
        if not truths:
            raise ProcessError("the simulator told no truth; see its log")
        return Repetition(ended, truths, self._witness.statuses, recording, obstacle_m)

    def _watch(self, runtime: Child, drive: Drive, advance: Callable[[float], None]) -> str:
        """ARRIVED, or why the repetition ended."""
        limit_s = REPEAT_FACTOR * len(drive.poses) * STEP_S + REPEAT_EXTRA_S
        verdict = ""

        def ended() -> bool:
            nonlocal verdict
            truths = self._witness.truths
            poses = np.array([truth.pose for truth in truths]).reshape(-1, 3)
            share, off_m = along(drive.poses, poses)
            if runtime.returncode is not None:
                verdict = self._last_word(runtime)
            elif not len(poses):
                return False
            elif truths[-1].collided:
                verdict = "COLLISION"
            elif off_m[-1] > OFF_ROUTE_M:
                verdict = "OFF ROUTE"
            elif self._stuck(poses):
                verdict = "STUCK"
            else:
                advance(float(share[-1]))
            return bool(verdict)

        try:
            self._until(ended, limit_s, "the repetition to end")
        except OverdueError:
            verdict = "TIMEOUT"
        if runtime.returncode is None:
            runtime.finish()
        return verdict

    def _stuck(self, poses: np.ndarray[Any, np.dtype[np.float64]]) -> bool:
        """Whether the robot has stood for long since the runtime began to drive."""
        if not self._witness.statuses or len(poses) < STUCK_STEPS:
            return False
        recent = poses[-STUCK_STEPS:, :2]
        return bool(np.hypot(*(recent - recent[0]).T).max() < STUCK_M)

    def _last_word(self, runtime: Child) -> str:
        if runtime.returncode == 0:
            return ARRIVED
        reasons = [status.reason for status in self._witness.statuses if status.reason]
        if runtime.returncode == EXIT_STOPPED and reasons:
            return f"STOPPED ({reasons[-1]})"
        raise ProcessError(f"cbe-runtime ended with code {runtime.returncode}:\n{runtime.tail()}")

    def _record(self, path: Path, log: str) -> Child:
        """Start recording; returns once it listens."""
        recorder = self._crew.start(
            "cbe-record", "-o", str(path), "--connect", self._endpoint, log=log
        )
        self._until(
            lambda: self._link.alive("record"), RECORDER_START_S, "cbe-record to start", recorder
        )
        return recorder

    def _finish(self, recorder: Child) -> None:
        if recorder.finish() != 0:
            raise ProcessError(f"cbe-record failed:\n{recorder.tail()}")
        self._until(
            lambda: not self._link.alive("record"), RECORDER_START_S, "cbe-record to be gone"
        )

    def _until(self, done: Callable[[], bool], timeout_s: float, what: str, *needed: Child) -> None:
        """Poll `done` while the simulator and what else is needed live.

        Raises:
            ProcessError: one of them ended.
            OverdueError: it takes too long.
        """
        deadline_s = time.monotonic() + timeout_s
        while not done():
            for child in (self._sim, *needed):
                child.require_running()
            if time.monotonic() > deadline_s:
                raise OverdueError(f"waited {timeout_s:.0f} s in vain for {what}")
            time.sleep(POLL_S)


def _world(config: DemoConfig) -> World:
    """What to plan in: an unseen generated house, or a scene's free space."""
    if config.scene is None:
        return generate(TEST_SEEDS[config.seed])
    from cbe_hil_sim.meshscene import load_scene

    return load_scene(config.scene).planning


def _sim_options(config: DemoConfig, course: Course) -> list[str]:
    # From the drive's own start: what is recorded before it shows the same place.
    options = ["--start=" + ",".join(f"{value:.6f}" for value in course.start)]
    if config.scene is None:
        options += ["--world", str(TEST_SEEDS[config.seed])]
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


def _in_background(call: Callable[[], dict[str, Any]]) -> Future[dict[str, Any]]:
    """The result of a call that another thread makes; that thread never holds up an exit."""
    future: Future[dict[str, Any]] = Future()

    def work() -> None:
        try:
            future.set_result(call())
        except CbeError as error:
            future.set_exception(error)

    Thread(target=work, daemon=True).start()
    return future


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
