"""Tells systemd, where it is the parent, how this process is doing (sd_notify's protocol)."""

from __future__ import annotations

import math
import os
import socket
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

BEATS_PER_TIMEOUT = 4.0
"""systemd asks for two at least."""


def notify(state: str) -> None:
    """Send a state such as `READY=1`; does nothing when not started by systemd."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]  # an abstract socket
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
        channel.setblocking(False)  # a manager that does not listen must not hold up a tick
        try:
            channel.connect(address)
            channel.sendall(state.encode())
        except OSError:
            return  # the next one may get through; without any, systemd restarts this process


class Heartbeat:
    """`READY=1` with the first beat, then `WATCHDOG=1` as often as the unit's WatchdogSec= needs.

    The loop beats after each healthy tick and only then: systemd ends a process whose ticks fail
    to come.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._every_s = _watchdog_s() / BEATS_PER_TIMEOUT
        self._due_s: float | None = None

    def beat(self) -> None:
        """A healthy tick has just been completed."""
        now_s = self._clock()
        if self._due_s is None:
            notify("READY=1")
            self._due_s = now_s
        if now_s >= self._due_s:
            self._due_s = now_s + self._every_s
            if math.isfinite(self._every_s):
                notify("WATCHDOG=1")


def _watchdog_s() -> float:
    """Silence after which systemd ends this process; inf where it does not watch it."""
    process = os.environ.get("WATCHDOG_PID")
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    if not microseconds.isdecimal() or process not in {None, "", str(os.getpid())}:
        return math.inf
    return int(microseconds) / 1e6 or math.inf
