import json
import sys

import numpy as np
import pytest

from cbe_runtime.timing import BOUNDS_MS, TICKS, Durations, Timings


def test_summary_of_nothing_is_null():
    assert set(Durations().summary().values()) == {None}


def test_percentiles_are_of_the_last_minute_and_the_worst_since_the_start():
    durations = Durations()
    durations.add(9.0)
    for ms in np.random.default_rng(0).permutation(TICKS):
        durations.add(1e-3 * ms)
    assert durations.summary() == {"p50": 299.0, "p99": 593.0, "last": float(ms), "max": 9000.0}


def test_every_duration_is_in_one_bin():
    durations = Durations()
    for ms in (0.1, 0.5, 0.6, 4.0, 30.0, 500.0, 501.0, 9e9):
        durations.add(1e-3 * ms)
    assert sum(durations.counts) == 8
    assert dict(zip([*BOUNDS_MS, "more"], durations.counts, strict=True)) == {
        0.5: 2, 1.0: 1, 2.0: 0, 5.0: 1, 10.0: 0, 20.0: 0, 50.0: 1, 100.0: 0, 200.0: 0, 500.0: 1,
        "more": 2,
    }  # fmt: skip


def test_memory_does_not_grow_with_ticks():
    durations = Durations()

    def size():
        return sum(sys.getsizeof(value) for value in vars(durations).values())

    durations.add(0.1)
    before = size()
    for _ in range(5 * TICKS):
        durations.add(0.1)
    assert size() == before


def test_status_names_each_duration_and_fits_a_message():
    timings = Timings()
    timings.tick.add(0.002)
    status = timings.status()
    assert status["tick_ms"]["p50"] == pytest.approx(2.0)
    assert {"jitter_ms", "inference_ms", "camera_to_command_ms", "scan_age_ms"} <= set(status)
    assert sum(status["histograms"]["tick"]) == 1
    assert len(status["histograms"]["bounds_ms"]) + 1 == len(status["histograms"]["tick"])
    assert len(json.dumps(status, allow_nan=False)) < 2_000
