"""An end that stays ahead however far the robot drives is no place to arrive at."""

import math

import pytest

from cbe_runtime.approach import Approach, ApproachConfig

OVER_M = ApproachConfig().over_m


def nearer_m(ahead_m, driven_m, step_m=0.05):
    """How much nearer the end came; `ahead_m` of the distance driven is what views show."""
    approach = Approach(ApproachConfig())
    for step in range(round(driven_m / step_m) + 1):
        approach.read(ahead_m(step * step_m))
        approach.carry(step_m)
    return approach.nearer_m


@pytest.mark.parametrize("scale", [0.0, 0.5, 1.0])
def test_end_comes_nearer_by_what_the_views_show_of_the_way(scale):
    assert nearer_m(lambda x_m: 2.0 - scale * x_m, 3.0) == pytest.approx(scale * OVER_M, abs=0.03)


def test_only_the_last_stretch_counts():
    deaf_m = OVER_M + 0.2
    assert nearer_m(lambda x_m: max(2.0 - x_m, deaf_m), 3.0) == pytest.approx(0.0, abs=0.03)


def test_single_readings_are_averaged():
    def flickering(x_m):
        return 2.0 - x_m + 0.05 * (-1) ** round(x_m / 0.05)

    assert nearer_m(flickering, 3.0) == pytest.approx(OVER_M, abs=0.07)


def test_nothing_is_said_before_the_robot_drove_so_far():
    assert nearer_m(lambda x_m: 0.3, OVER_M - 0.2) == math.inf


def test_standing_robot_stays_where_it_was():
    approach = Approach(ApproachConfig())
    for _ in range(50):
        approach.read(0.3)
    assert approach.nearer_m == math.inf
