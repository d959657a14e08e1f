import pytest

from cbe_bench.soak import Soaked

GOOD = {
    "minutes": 15.0, "laps": 30, "ticks": 9_000, "missed": 0, "over_p99_bar": 0,
    "worst_tick_ms": 20.0, "camera_to_command_ms": {"p50": 3.0, "p99": 9.0}, "rss_mib": 90.0,
    "growth_mib": 0.1, "cpu": 0.04, "stolen": 0.01,
}  # fmt: skip


def test_run_within_the_bars_has_no_failures():
    soaked = Soaked(**GOOD)
    assert soaked.failures == []
    assert "memory growth" in soaked.table()


@pytest.mark.parametrize(
    ("field", "value"),
    [("growth_mib", 2.0), ("missed", 9), ("over_p99_bar", 90), ("worst_tick_ms", 50.0)],
)
def test_each_bar_that_is_not_met_is_named(field, value):
    soaked = Soaked(**GOOD | {field: value})
    assert len(soaked.failures) == 1
    assert soaked.json()["failures"] == soaked.failures
