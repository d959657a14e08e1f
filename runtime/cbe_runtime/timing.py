"""How long things take: percentiles over the last minute, histograms since the start."""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import Any

import numpy as np

TICKS = 600
BOUNDS_MS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
"""Upper bounds of a histogram's bins; one more bin holds what is longer."""


class Durations:
    """A ring of the last durations, and a histogram of all of them; its size never changes."""

    def __init__(self) -> None:
        self._ring_s = np.zeros(TICKS)
        self._count = 0
        self._max_s = 0.0
        self.counts = [0] * (len(BOUNDS_MS) + 1)
        """How many fell into each bin of `BOUNDS_MS` since the start."""

    def add(self, duration_s: float) -> None:
        """Take the newest duration in."""
        self._ring_s[self._count % TICKS] = duration_s
        self._count += 1
        self._max_s = max(self._max_s, duration_s)
        self.counts[bisect_left(BOUNDS_MS, 1e3 * duration_s)] += 1

    def summary(self) -> dict[str, float | None]:
        """Median and 99th percentile of the last minute, newest, and the largest since the start.

        In milliseconds; None before the first.
        """
        if self._count == 0:
            return {"p50": None, "p99": None, "last": None, "max": None}
        ordered = np.sort(self._ring_s[: min(self._count, TICKS)])
        values = {
            "p50": ordered[(len(ordered) - 1) // 2],
            "p99": ordered[math.ceil(0.99 * len(ordered)) - 1],
            "last": self._ring_s[(self._count - 1) % TICKS],
            "max": self._max_s,
        }
        return {name: round(1e3 * float(value), 3) for name, value in values.items()}


class Timings:
    """The loop's durations by name.

    `tick` from the observation to the command sent; `camera_to_command` from a frame's receipt to
    the command that answers it; `jitter` by which a tick began off its deadline; `inference` of a
    step in which the networks ran; `camera_age` and `scan_age` of what a tick saw.
    """

    def __init__(self) -> None:
        self.tick = Durations()
        self.camera_to_command = Durations()
        self.jitter = Durations()
        self.inference = Durations()
        self.camera_age = Durations()
        self.scan_age = Durations()

    def status(self) -> dict[str, Any]:
        """`<name>_ms` with a summary each, and `histograms` with the counts of every bin."""
        named: dict[str, Durations] = vars(self)
        summaries = {f"{name}_ms": durations.summary() for name, durations in named.items()}
        counts = {name: durations.counts for name, durations in named.items()}
        return summaries | {"histograms": {"bounds_ms": BOUNDS_MS, **counts}}
