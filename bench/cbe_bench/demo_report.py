"""What came of a repetition: its verdict, the table of its figures and its pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cbe import geometry
from cbe.images import decode_image
from cbe.messages import CompressedImage, TwistStamped
from cbe.robot import STEP_S
from cbe_bench import pictures
from cbe_bench.demo_witness import Status, Truth, along
from cbe_bench.episode import SUCCESS_M, SUCCESS_RAD
from cbe_runtime import mcapfile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cbe_hil_sim.world import World
    from cbe_runtime.route import Route

ARRIVED = "ARRIVED"
COLUMNS = 8  # of the filmstrip
MOVED_M = 0.003
CLOCK_CHANGE_S = 10.0  # before the first frame even a lock-step command has the wall's time


@dataclass(frozen=True, slots=True)
class Drive:
    """A demonstration: true poses (T, 3), one a step from `first_ns` on, and its recording."""

    poses: NDArray[np.float64]
    first_ns: int
    recording: Path
    doors: int

    @property
    def length_m(self) -> float:
        """Distance driven."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())

    @property
    def moving(self) -> NDArray[np.float64]:
        """The poses (M, 3) without those at rest, as teaching leaves them out."""
        moved = np.hypot(*np.diff(self.poses[:, :2], axis=0).T) > MOVED_M
        moving: NDArray[np.float64] = self.poses[np.concatenate([[True], moved])]
        return moving


@dataclass(frozen=True, slots=True)
class Repetition:
    """A repeated drive; `ended` is ARRIVED where the runtime said so, else why it ended."""

    ended: str
    truths: Sequence[Truth]
    statuses: Sequence[Status]
    recording: Path
    bin_pose: tuple[float, float, float] | None

    @property
    def poses(self) -> NDArray[np.float64]:
        """True poses (N, 3), one a step."""
        return np.array([truth.pose for truth in self.truths]).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class Report:
    """A taught and repeated drive, judged by truth."""

    drive: Drive
    route: Route
    route_bytes: int
    repetition: Repetition

    @property
    def error(self) -> tuple[float, float]:
        """Distance (m) and angle (rad) between where the two drives ended."""
        error = geometry.relative(self.drive.poses[-1], self.repetition.poses[-1])
        return float(np.hypot(error[0], error[1])), abs(float(error[2]))

    @property
    def outcome(self) -> str:
        """ARRIVED if the runtime said so, truly near the end and without touching anything."""
        if any(truth.collided for truth in self.repetition.truths):
            return "COLLISION"
        error_m, error_rad = self.error
        if self.repetition.ended == ARRIVED and (error_m > SUCCESS_M or error_rad > SUCCESS_RAD):
            return "FALSE ARRIVAL"
        return self.repetition.ended

    @property
    def succeeded(self) -> bool:
        """Whether the robot truly arrived."""
        return self.outcome == ARRIVED

    def table(self) -> str:
        """The figures, a line each."""
        drive, repetition = self.drive, self.repetition
        error_m, error_rad = self.error
        clearance = min(truth.clearance_m for truth in repetition.truths)
        drive_bytes = drive.recording.stat().st_size
        last = repetition.statuses[-1] if repetition.statuses else None
        rows = (
            ("outcome", self.outcome),
            ("final error", f"{error_m:.2f} m, {math.degrees(error_rad):.1f} deg"),
            ("min clearance", f"{clearance:.2f} m" if math.isfinite(clearance) else "over 1 m"),
            ("drive", f"{drive.length_m:.1f} m, {len(drive.poses)} steps, {drive.doors} doors"),
            ("route", f"{self.route_bytes:,} bytes in {len(self.route.segments)} segments"),
            ("drive's recording", f"{drive_bytes:,} bytes ({drive_bytes // self.route_bytes} x)"),
            ("tick p50 / p99", _pair(last.tick_ms if last else {})),
            ("camera to command", _pair(last.camera_to_command_ms if last else {})),
            ("command rate", f"{_command_rate_hz(repetition.recording):.2f} Hz"),
        )
        return "".join(f"  {name:<18} {value}\n" for name, value in rows)

    def draw(self, folder: Path, world: World, done: Callable[[], object]) -> None:
        """Write the three pictures; `done` is called after each."""
        demonstration, repeated = self.drive.poses, self.repetition.poses
        joints = np.cumsum([0, *(segment.steps for segment in self.route.segments)])
        shares = joints / joints[-1]
        moving = self.drive.moving
        at_joints = moving[np.rint(shares * (len(moving) - 1)).astype(int), :2]
        pictures.overview(
            folder / "overview.png", world, demonstration, repeated, at_joints,
            self.repetition.bin_pose, f"{world.name}: {self.outcome}",
        )  # fmt: skip
        done()
        stamps, believed = self._believed(shares)
        if not len(stamps):
            return
        self._draw_filmstrip(folder / "filmstrip.png", stamps, believed)
        done()
        share, off_m = along(demonstration, repeated)
        at = np.searchsorted([truth.stamp_ns for truth in self.repetition.truths], stamps)
        time_s = (stamps - stamps[0]) * 1e-9
        pictures.progress(
            folder / "progress.png", time_s, believed, share[at], off_m[at], shares[1:-1]
        )
        done()

    def _believed(
        self, shares: NDArray[np.floating]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Stamps (N,) and the networks' progress over the whole route (N,)."""
        first = self.repetition.truths[0].stamp_ns
        seen = [
            status
            for status in self.repetition.statuses
            if status.state in ("FOLLOWING", ARRIVED) and status.stamp_ns >= first
        ]
        believed = [
            np.interp(status.progress, (0.0, 1.0), shares[status.segment : status.segment + 2])
            for status in seen
        ]
        return np.array([status.stamp_ns for status in seen], np.int64), np.array(believed)

    def _draw_filmstrip(
        self, path: Path, stamps: NDArray[np.int64], believed: NDArray[np.float64]
    ) -> None:
        shown = np.linspace(0.0, believed.max(), COLUMNS)
        repeated = [int(stamps[int((believed >= share).argmax())]) for share in shown]
        steps = np.rint(shown * (len(self.drive.poses) - 1)).astype(int)
        taught = [self.drive.first_ns + round(step * STEP_S * 1e9) for step in steps.tolist()]
        pictures.filmstrip(
            path,
            _frames(self.drive.recording, taught),
            _frames(self.repetition.recording, repeated),
            shown.tolist(),
        )


def _frames(recording: Path, stamps_ns: Sequence[int]) -> list[NDArray[np.uint8]]:
    """The recorded camera frames closest to the stamps."""
    frames = [
        CompressedImage.from_cdr(message.data)
        for message in mcapfile.read(recording)
        if message.type_name == CompressedImage.TYPE
    ]
    times = np.array([frame.stamp_ns for frame in frames])
    return [decode_image(frames[int(np.abs(times - stamp).argmin())]) for stamp in stamps_ns]


def _command_rate_hz(recording: Path) -> float:
    """Commands a second, by their stamps: simulated time in lock-step."""
    stamps = {
        TwistStamped.from_cdr(message.data).stamp_ns
        for message in mcapfile.read(recording)
        if message.type_name == TwistStamped.TYPE
    }
    gaps_s = np.diff(sorted(stamps)) * 1e-9
    gaps_s = gaps_s[gaps_s < CLOCK_CHANGE_S]
    return float(1.0 / gaps_s.mean()) if len(gaps_s) else 0.0


def _pair(milliseconds: dict[str, float | None]) -> str:
    p50, p99 = milliseconds.get("p50"), milliseconds.get("p99")
    return "none" if p50 is None or p99 is None else f"{p50:.1f} / {p99:.1f} ms"
