"""Routes taught well and badly are linted on their own recordings and driven with good eyes."""

import json

import numpy as np
import pytest

from cbe_bench import lint
from cbe_bench.cli import main
from cbe_bench.episode import Outcome
from cbe_bench.lint import Linted, Quality
from cbe_bench.tally import independent_difference


def views(count):
    return list(np.random.default_rng(0).integers(60, 200, (count, 64, 64, 3), np.uint8))


def spoilt(quality):
    return np.stack(quality.spoilt(views(21), np.random.default_rng(0)))


def test_each_quality_spoils_the_recording_in_its_own_way() -> None:
    filmed = np.stack(views(21))
    assert np.array_equal(spoilt(Quality.GOOD), filmed)
    assert spoilt(Quality.DIM).mean() < 0.2 * filmed.mean()
    assert spoilt(Quality.SOFT).std() < 0.2 * filmed.std()
    assert (np.ptp(spoilt(Quality.COVERED), axis=0) == 0).mean() > 0.5
    assert len(np.unique(spoilt(Quality.SLOW), axis=0)) == 3
    for quality in Quality:
        assert spoilt(quality).shape == filmed.shape
        assert spoilt(quality).dtype == np.uint8


def test_lint_command_writes_what_was_foretold_and_what_came(tmp_path, counting, capsys) -> None:
    path = tmp_path / "lint.json"
    options = ["--length-m", "6", "--episodes", "2", "--jobs", "1", "--world", "val"]
    assert main(["lint", *options, "--model", ".", "--json", str(path)]) == 0
    result = json.loads(path.read_text())
    assert result["episodes"] == 2
    assert result["passed"]["routes"] + result["flagged"]["routes"] == 2
    assert [run["quality"] for run in result["runs"]] == [Quality.GOOD, Quality.LONG]
    # The stub counts ticks, not what it sees: no progress is right.
    assert "progress" in result["runs"][0]["verdict"]["segments"][0]["flags"]
    assert "passed less flagged" in capsys.readouterr().out


def test_shares_are_of_the_routes_that_passed() -> None:
    good = Linted(0, Quality.GOOD, True, 0.9, Outcome.ARRIVED, {})
    bad = Linted(1, Quality.DIM, False, 0.1, Outcome.STUCK, {})
    row = lint._tally([good, bad, good, bad])
    assert (row["routes"], row["success"], row["passed"]) == (4, 0.5, 0.5)
    assert row["predicted_success"] == pytest.approx(0.5)


def test_difference_of_independent_rates_is_newcombes() -> None:
    # Newcombe (1998), example: 56 of 70 and 48 of 80, method 10.
    difference, low, high = independent_difference(56, 70, 48, 80)
    assert difference == pytest.approx(0.2)
    assert (low, high) == pytest.approx((0.0524, 0.3339), abs=1e-4)
    assert independent_difference(0, 0, 1, 2) == (0.0, -1.0, 1.0)
