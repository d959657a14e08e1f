"""Rates, intervals and paired comparisons."""

import json
import math
from dataclasses import replace

import pytest

from cbe.errors import ConfigError
from cbe_bench.episode import Outcome
from cbe_bench.tally import Record, compare, paired_difference, summary, wilson

ARRIVED = Record(
    index=0, world_seed=7, goal=(1.0, 2.0, 0.5), outcome=Outcome.ARRIVED, success=True,
    success_paper=True, spl=0.9, final_error_m=0.2, final_error_deg=5.0, min_clearance_m=0.1,
    steps=80,
)  # fmt: skip
HIT = replace(
    ARRIVED, outcome=Outcome.COLLISION, success=False, spl=0.0, final_error_m=3.0,
    min_clearance_m=-0.01,
)  # fmt: skip


def results(*successes: bool, **config: object) -> dict:
    records = [
        replace(ARRIVED if good else HIT, index=index) for index, good in enumerate(successes)
    ]
    return summary(records, {"seed": 0} | config, "0011223344556677")


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [  # Newcombe 1998, table I (method 3)
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_gives_published_intervals(successes, trials, low, high) -> None:
    assert wilson(successes, trials) == pytest.approx((low, high), abs=1e-4)


def test_wilson_of_nothing_excludes_nothing() -> None:
    assert wilson(0, 0) == (0.0, 1.0)


def test_paired_difference_gives_the_published_interval() -> None:
    # Agresti and Min 2005, their adjusted Wald interval, computed by hand: (0.5 added to 9 and 3).
    difference, low, high = paired_difference(9, 3, 100)
    half = 1.959964 * math.sqrt(13.0 - 36.0 / 102.0) / 102.0
    assert difference == pytest.approx(-0.06)
    assert (low, high) == pytest.approx((-6.0 / 102.0 - half, -6.0 / 102.0 + half))


def test_summary_has_the_promised_keys_and_is_json() -> None:
    result = results(True, False)
    promised = {
        "episodes", "success", "success_paper", "ci95", "spl", "outcomes", "mean_final_error_m",
        "mean_final_error_deg", "min_clearance_m", "config", "model_id",
    }  # fmt: skip
    assert promised <= result.keys()
    outcomes = {"arrived", "collision", "off_route", "stuck", "timeout", "false_arrival"}
    assert result["outcomes"].keys() == outcomes
    assert json.loads(json.dumps(result, allow_nan=False))["runs"][1]["outcome"] == "collision"


def test_summary_counts() -> None:
    result = results(True, True, False, True)
    assert result["success"] == 0.75
    assert result["outcomes"]["arrived"] == 3
    assert result["outcomes"]["collision"] == 1
    assert result["mean_final_error_m"] == pytest.approx(0.2)  # of the declared arrivals
    assert result["min_clearance_m"] == 0.1  # of those without collision


def test_summary_without_arrival_is_still_json() -> None:
    assert json.dumps(results(False), allow_nan=False)


def test_comparison_pairs_by_episode() -> None:
    result = compare(results(True, True, False, False), results(True, False, False, True))
    assert (result["only_a"], result["only_b"], result["pairs"]) == (1, 1, 4)
    assert result["difference"] == 0.0
    low, high = result["ci95"]
    assert low < 0.0 < high


def test_comparison_leaves_out_episodes_that_differ() -> None:
    a, b = results(True, True), results(True, False)
    b["runs"][1]["goal"] = (1.0, 2.5, 0.5)
    assert compare(a, b)["pairs"] == 1
    assert compare(a, b)["unpaired"] == 1


def test_comparison_names_what_was_run_differently() -> None:
    result = compare(results(True, noise=0.0), results(True, noise=0.5))
    assert result["differing_config"] == {"noise": [0.0, 0.5]}


@pytest.mark.parametrize("other", [{}, {"runs": [{}], "config": {}, "model_id": ""}])
def test_comparison_refuses_what_is_no_result(other) -> None:
    with pytest.raises(ConfigError):
        compare(results(True), other)


def test_comparison_of_nothing_in_common_is_refused() -> None:
    b = results(True)
    b["runs"][0]["world_seed"] = 8
    with pytest.raises(ConfigError, match="share no episode"):
        compare(results(True), b)
