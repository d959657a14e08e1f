"""Sees from outside the loop's thread that it hangs, in the networks or in the link."""

from __future__ import annotations

import logging
import os
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from cbe.errors import LinkError

if TYPE_CHECKING:
    from collections.abc import Callable

logger = logging.getLogger(__name__)

STOP_S = 0.35
"""Without a tick for this long, the robot is told to stop: robots obey a command for 0.3 s."""
END_S = 2.0
"""Without a tick for this long, the process ends: nothing else frees a thread that hangs."""
EXIT_HUNG = 5
POLL_S = 0.05
REPEAT_S = 0.1


class Watchdog:
    """Stops the robot when beats fail to come, and ends the process when they do not come back.

    Only time in which this thread ran counts: a process that was suspended has not hung.
    """

    def __init__(
        self,
        stop: Callable[[], None],
        end: Callable[[int], object] = os._exit,
        clock: Callable[[], float] = time.monotonic,
        stop_s: float = STOP_S,
        end_s: float = END_S,
    ) -> None:
        """`stop` sends one stop command; it may block or raise LinkError."""
        self._stop = stop
        self._end = end
        self._clock = clock
        self._stop_s = stop_s
        self._end_s = end_s
        self._beats = 0
        self._seen = 0
        self._driving = False
        self._silent_s = 0.0
        self._polled_s = 0.0
        self._closed = threading.Event()
        self._back = threading.Event()  # the loop ticks
        self._back.set()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self.trips = 0
        """How often the loop hung for so long that the robot was told to stop."""

    def __enter__(self) -> Self:
        self._polled_s = self._clock()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._thread.join()

    def beat(self, *, driving: bool) -> None:
        """A tick is complete; `driving` tells whether its command moves the robot."""
        self._driving = driving
        self._beats += 1

    def poll(self) -> None:
        """Judge the silence; the watchdog's thread calls it every `POLL_S`."""
        now_s = self._clock()
        self._silent_s += min(now_s - self._polled_s, 2.0 * POLL_S)
        self._polled_s = now_s
        if self._beats != self._seen:
            self._seen = self._beats
            self._silent_s = 0.0
            self._back.set()
        elif self._silent_s > self._end_s:
            self._end(EXIT_HUNG)
        elif self._silent_s > self._stop_s and self._driving and self._back.is_set():
            self._back.clear()
            self.trips += 1
            # A thread of its own: the link, or the log, may be what hangs.
            threading.Thread(target=self._stop_until_back, name="stopper", daemon=True).start()

    def _run(self) -> None:
        while not self._closed.wait(POLL_S):
            self.poll()

    def _stop_until_back(self) -> None:
        complained = False
        while not self._back.is_set() and not self._closed.is_set():
            with suppress(LinkError):
                self._stop()
            if not complained:
                complained = True
                logger.error("the loop hangs: no tick for %g s; stopping the robot", self._stop_s)
            self._back.wait(REPEAT_S)
