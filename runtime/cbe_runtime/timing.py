"""How long things take: percentiles over the last minute of ticks."""

import numpy as np

TICKS = 600


class Durations:
    """A ring of the last durations."""

    def __init__(self) -> None:
        self._ring_s = np.zeros(TICKS)
        self._count = 0

    def add(self, duration_s: float) -> None:
        """Take the newest duration in."""
        self._ring_s[self._count % TICKS] = duration_s
        self._count += 1

    def summary(self) -> dict[str, float | None]:
        """Median, 99th percentile and newest in milliseconds; None before the first."""
        if self._count == 0:
            return {"p50": None, "p99": None, "last": None}
        p50, p99 = np.percentile(self._ring_s[: min(self._count, TICKS)], [50, 99])
        last = self._ring_s[(self._count - 1) % TICKS]
        names = ("p50", "p99", "last")
        return {
            name: round(1e3 * float(value), 3)
            for name, value in zip(names, (p50, p99, last), strict=True)
        }
