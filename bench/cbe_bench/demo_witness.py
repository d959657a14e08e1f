"""What truly happens and what the runtime says of it, collected from the link."""

from __future__ import annotations

import math
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any, Self

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from cbe.inbox import Latest
    from cbe.link import Link

POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class Truth:
    """One step of the simulator: pose (x m, y m, yaw rad); clearance inf where out of reach."""

    stamp_ns: int
    pose: tuple[float, float, float]
    speed_mps: float
    clearance_m: float
    collided: bool

    @classmethod
    def read(cls, fields: dict[str, Any]) -> Truth:
        """From the simulator's JSON."""
        x, y, yaw = fields["pose"]
        clearance = fields["clearance_m"]
        return cls(
            stamp_ns=fields["stamp_ns"],
            pose=(x, y, yaw),
            speed_mps=fields["speed_mps"],
            clearance_m=math.inf if clearance is None else clearance,
            collided=fields["collided"],
        )


@dataclass(frozen=True, slots=True)
class Status:
    """One tick of the runtime; `stamp_ns` is that of the newest truth when it came."""

    stamp_ns: int
    state: str
    reason: str | None
    segment: int
    progress: float
    tick_ms: dict[str, float | None]
    camera_to_command_ms: dict[str, float | None]

    @classmethod
    def read(cls, fields: dict[str, Any], stamp_ns: int) -> Status:
        """From the runtime's JSON."""
        return cls(
            stamp_ns=stamp_ns,
            state=fields["state"],
            reason=fields["reason"],
            segment=fields["segment"],
            progress=fields["progress"],
            tick_ms=fields["tick_ms"],
            camera_to_command_ms=fields["camera_to_command_ms"],
        )


class Witness:
    """Keeps every truth and status since the last `restart`. Close it, or use `with`."""

    def __init__(self, link: Link) -> None:
        self._lock = Lock()
        self._truths: list[Truth] = []
        self._statuses: list[Status] = []
        self._closed = Event()
        collectors = (("truth", self._saw), ("status", self._heard))
        self._threads = [
            Thread(target=self._collect, args=(link.latest_json(name), keep), daemon=True)
            for name, keep in collectors
        ]
        for thread in self._threads:
            thread.start()

    def restart(self) -> None:
        """Forget what came so far."""
        with self._lock:
            self._truths, self._statuses = [], []

    @property
    def truths(self) -> list[Truth]:
        """A copy, oldest first, one a step."""
        with self._lock:
            return self._truths[:]

    @property
    def statuses(self) -> list[Status]:
        """A copy, oldest first, one a tick."""
        with self._lock:
            return self._statuses[:]

    def close(self) -> None:
        """Stop collecting."""
        self._closed.set()
        for thread in self._threads:
            thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _collect(
        self, inbox: Latest[dict[str, Any]], keep: Callable[[dict[str, Any]], None]
    ) -> None:
        count = 0
        while not self._closed.is_set():
            received = inbox.wait(after=count, timeout_s=POLL_S)
            if received is None or received.message is None:
                continue
            count = received.count
            keep(received.message)

    def _saw(self, fields: dict[str, Any]) -> None:
        truth = Truth.read(fields)
        with self._lock:
            if not self._truths or self._truths[-1].stamp_ns < truth.stamp_ns:
                self._truths.append(truth)

    def _heard(self, fields: dict[str, Any]) -> None:
        with self._lock:
            if self._truths:  # what is said before has no place in time
                self._statuses.append(Status.read(fields, self._truths[-1].stamp_ns))


def along(
    demonstration: NDArray[np.floating], poses: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far along a drive (T, 3) poses (N, 3) are, as shares (N,), and how far off in m (N,).

    Each is matched near the one before, since drives may cross themselves.
    """
    steps = np.hypot(*np.diff(demonstration[:, :2], axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    share, off = np.zeros(len(poses)), np.zeros(len(poses))
    nearest = 0
    for index, pose in enumerate(poses):
        first = max(nearest - 10, 0)
        distance = np.hypot(*(demonstration[first : nearest + 40, :2] - pose[:2]).T)
        nearest = first + int(distance.argmin())
        share[index], off[index] = travelled[nearest], distance.min()
    return share / max(travelled[-1], 1e-9), off
