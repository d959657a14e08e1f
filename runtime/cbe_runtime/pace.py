"""When the next tick is due: absolute deadlines in real time, or a simulator's frames."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable
    from threading import Event

    from cbe_runtime.observation import Observation
    from cbe_runtime.sensors import Sensors

LEAD_S = 0.004
"""A tick aims at this long after its camera frame came: the frame's jitter, no more."""
MAX_SHIFT_S = 0.02
POLL_S = 0.05
MAX_REPEATS = 3
SCAN_PATIENCE_S = 1.0


class Pace(Protocol):
    """Decides when to tick."""

    overruns: int

    def wait(self, observation: Observation) -> None:
        """Return when the tick after the one that saw `observation` is due."""


class Ratekeeper:
    """Waits for absolute, monotonic deadlines; those missed by an overrun are skipped.

    The deadlines' phase slides to just after the camera's frames:
    else a frame would wait for its tick half a period on average.
    """

    def __init__(
        self, period_s: float, exiting: Event, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin now; `exiting` ends every wait at once."""
        self._period_s = period_s
        self._exiting = exiting
        self._clock = clock
        self._due_s = clock()
        self.overruns = 0
        """Deadlines that passed while a tick was still running."""

    def wait(self, observation: Observation) -> None:
        """Return at the next deadline that lies ahead."""
        began_s = self._due_s
        self._due_s += self._period_s
        if observation.frame is not None:
            self._due_s -= self._shift(began_s - observation.frame.received_s)
        late_s = self._clock() - self._due_s
        if late_s > 0.0:
            missed = int(late_s // self._period_s) + 1
            self.overruns += missed
            self._due_s += missed * self._period_s
        self._exiting.wait(max(self._due_s - self._clock(), 0.0))

    def _shift(self, age_s: float) -> float:
        """How much earlier to tick, from the frame's age at the last deadline."""
        if not 0.0 <= age_s < self._period_s:
            return 0.0
        error_s = age_s - LEAD_S
        if error_s > 0.5 * self._period_s:
            error_s -= self._period_s  # the next frame is nearer than the last one
        return max(-MAX_SHIFT_S, min(0.5 * error_s, MAX_SHIFT_S))


class LockStep:
    """Ticks once for every new camera frame and its scan: simulated time.

    A frame that is sent again was answered by a command that got lost: `repeat` sends it anew.
    Without a new frame for `patience_s` of wall time, or when one frame comes again and again, it
    ticks all the same, so that the follower sees the silence.
    """

    def __init__(
        self,
        sensors: Sensors,
        exiting: Event,
        repeat: Callable[[], None],
        patience_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._sensors = sensors
        self._exiting = exiting
        self._repeat = repeat
        self._patience_s = patience_s
        self._clock = clock
        self.overruns = 0

    def wait(self, observation: Observation) -> None:
        """Return at the next new frame once its scan is there too, or when patience ends."""
        answered_ns = observation.frame.stamp_ns if observation.frame else None
        began_s = self._clock()
        repeats = 0
        while not self._exiting.is_set() and self._clock() - began_s < self._patience_s:
            if not self._sensors.wait_for_frame(POLL_S):
                continue
            frame = self._sensors.observe().frame
            assert frame is not None
            if frame.stamp_ns != answered_ns:
                self._await_scan(frame.stamp_ns)
                return
            repeats += 1
            if repeats > MAX_REPEATS or self._clock() - began_s > 0.5 * self._patience_s:
                return  # at once, so that the follower sees a repeated frame and not an old one
            self._repeat()

    def _await_scan(self, stamp_ns: int) -> None:
        give_up_s = self._clock() + SCAN_PATIENCE_S
        while not self._exiting.is_set() and self._clock() < give_up_s:
            scan = self._sensors.observe().scan
            if scan is not None and scan.stamp_ns >= stamp_ns:
                return
            self._sensors.wait_for_scan(POLL_S)
