"""When the next tick is due: absolute deadlines in real time, or a simulator's frames."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable
    from threading import Event

    from cbe_runtime.observation import Observation
    from cbe_runtime.sensors import Sensors

WINDOW_S = 0.025
"""A tick goes with its camera frame if that comes this near to the deadline, before or after."""
SHIFT = 0.25
MAX_SHIFT_S = 0.005
"""Deadlines slide to where the frames come: a twentieth of the period at most, never in bursts."""
POLL_S = 0.05
MAX_REPEATS = 3
SCAN_PATIENCE_S = 1.0


class Pace(Protocol):
    """Decides when to tick."""

    overruns: int
    jitter_s: float
    """By how much the tick that is now due begins off its deadline."""

    def wait(self, observation: Observation) -> None:
        """Return when the tick after the one that saw `observation` is due."""


class Camera(Protocol):
    """What sets the pace; `Sensors` is one."""

    @property
    def frame_received_s(self) -> float:
        """When the newest frame seen came, -inf before the first."""

    def wait_for_frame_since(self, since_s: float, timeout_s: float) -> bool:
        """Whether a frame came since some time, or does within the time to come."""


class Ratekeeper:
    """Waits for absolute, monotonic deadlines; those missed by an overrun are skipped.

    Within a window round its deadline a tick goes with the camera's frame, at the window's end
    without one. A frame that just missed a tick would else wait a whole period for the next. The
    deadlines' phase jumps to where the first frame came, and then slides slowly to the others.
    """

    def __init__(
        self,
        period_s: float,
        exiting: Event,
        camera: Camera,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin now; `exiting` ends every wait at once."""
        self._period_s = period_s
        self._exiting = exiting
        self._camera = camera
        self._clock = clock
        self._due_s = clock()
        self._in_phase = False
        self.jitter_s = 0.0
        self.overruns = 0
        """Deadlines that passed while a tick was still running."""

    def wait(self, observation: Observation) -> None:
        """Return at the next deadline that lies ahead, or with the frame that comes near it."""
        del observation  # it is the frame's time of receipt that counts
        self._due_s += self._period_s - self._shift()
        late_s = self._clock() - self._due_s
        if late_s > WINDOW_S:
            missed = int(late_s // self._period_s) + 1
            self.overruns += missed
            self._due_s += missed * self._period_s
        opens_s, closes_s = self._due_s - WINDOW_S, self._due_s + WINDOW_S
        if not self._exiting.wait(max(opens_s - self._clock(), 0.0)):
            self._camera.wait_for_frame_since(opens_s, max(closes_s - self._clock(), 0.0))
        self.jitter_s = abs(self._clock() - self._due_s)

    def _shift(self) -> float:
        """How much earlier to tick, from when the frame of the last deadline came."""
        early_s = self._due_s - self._camera.frame_received_s
        if abs(early_s) > self._period_s:
            return 0.0  # there is none, or it is an old one
        error_s = math.remainder(early_s, self._period_s)
        if not self._in_phase:
            self._in_phase = True
            return error_s
        return max(-MAX_SHIFT_S, min(SHIFT * error_s, MAX_SHIFT_S))


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
        self.jitter_s = 0.0

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
