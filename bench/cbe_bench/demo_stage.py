"""The demonstration's acts on one simulator: drive and record, teach, repeat and record."""

from __future__ import annotations

import time
from concurrent.futures import Future
from dataclasses import dataclass
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from cbe.errors import CbeError
from cbe.robot import STEP_S, Robot
from cbe_bench.demo_course import bin_place, jittered_start
from cbe_bench.demo_processes import OverdueError, ProcessError
from cbe_bench.demo_report import ARRIVED, Drive, Repetition
from cbe_bench.demo_witness import along

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from cbe.link import Link
    from cbe_bench.demo_course import Course
    from cbe_bench.demo_processes import Child, Crew
    from cbe_bench.demo_witness import Witness
    from cbe_hil_sim.world import World

DRIVE_S, TEACH_S = 90.0, 60.0  # deadlines, far beyond what is usual
RECORDER_START_S, RECORD_S = 30.0, 300.0
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


class Stage:
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
        config, bin_pose = self._config, None
        if config.obstacle:
            place = bin_place(world, drive.poses, config.seed)
            self._link.call("obstacle", {"pose": place.tolist()}, timeout_s=30.0)
            bin_pose = (float(place[0]), float(place[1]), float(place[2]))
        start = jittered_start(world, drive.poses[0], config.seed)
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
        return Repetition(ended, truths, self._witness.statuses, recording, bin_pose)

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

    def _stuck(self, poses: NDArray[np.float64]) -> bool:
        """Whether the robot has stood for long since the runtime began to drive."""
        statuses, truths = self._witness.statuses, self._witness.truths
        # A runtime that is slow to start is not stuck.
        driven_ns = truths[-1].stamp_ns - statuses[0].stamp_ns if statuses else 0
        if driven_ns * 1e-9 < STUCK_STEPS * STEP_S:
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
        # The limit ends it even if this process is killed the hard way.
        recorder = self._crew.start(
            "cbe-record", "-o", str(path), "--connect", self._endpoint,
            "--duration", str(RECORD_S), log=log,
        )  # fmt: skip
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
