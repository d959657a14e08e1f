"""An arrived robot stands where it saw the end, or farther on while its view gets more alike."""

import numpy as np
import pytest

from cbe.controller import Motion
from cbe.parking import REACH_M
from cbe.robot import STEP_S, Robot
from cbe_runtime.berth import Berth, BerthConfig


def driven_m(read_m, unlike, end_m=None):
    """How far it drives; `unlike` is of the distance.

    The end is first read `read_m` ahead, then at `end_m`, or where it was if that is None.
    """
    berth = Berth(Robot(), BerthConfig())
    berth.take(pose(read_m), unlike(0.0), 1.0)
    motion, x_m = Motion(np.array([0.5]), np.zeros(1)), 0.0
    for step in range(100):
        motion = berth.step(motion)
        travel_m = float(motion.speed_mps[0]) * STEP_S
        if travel_m == 0.0:
            return x_m
        x_m += travel_m
        berth.carry((berth.pose[0] - travel_m, 0.0), travel_m, 0.0)
        if step % 2 == 1:
            read = berth.pose if end_m is None else pose(end_m - x_m)
            berth.look(read, unlike(x_m), 1.0)
    pytest.fail("never stood")


def pose(x_m):
    """Straight ahead."""
    return np.array([x_m, 0.0, 0.0])


def test_stands_where_the_end_was_read_if_the_view_agrees():
    assert driven_m(0.4, lambda x_m: 0.1 + 0.2 * abs(x_m - 0.4)) == pytest.approx(0.4, abs=0.12)


@pytest.mark.parametrize("end_m", [0.3, 0.5])
def test_drives_on_to_an_end_that_was_read_too_near(end_m):
    stood_m = driven_m(0.15, lambda x_m: 0.1 + 0.2 * abs(x_m - end_m))
    assert stood_m == pytest.approx(end_m, abs=0.1)


def test_does_not_drive_past_an_end_that_was_read_too_far():
    stood_m = driven_m(0.8, lambda x_m: 0.1 + 0.3 * abs(x_m - 0.3))
    assert stood_m == pytest.approx(0.4, abs=0.15)


def test_view_that_does_not_change_says_nothing():
    assert driven_m(0.2, lambda x_m: 0.2) == pytest.approx(0.2, abs=0.05)


def test_view_that_gets_more_alike_for_ever_does_not_lead_astray():
    assert driven_m(0.2, lambda x_m: 1.0 - 0.3 * x_m) < 0.2 + BerthConfig().beyond_m + 0.05


def test_later_views_correct_the_first():
    assert driven_m(0.7, lambda x_m: 0.2, end_m=0.4) == pytest.approx(0.4, abs=0.1)


def test_headings_are_corrected_the_short_way_round():
    berth = Berth(Robot(), BerthConfig())
    berth.take(np.array([0.5, 0.0, 3.1]), 0.2, 1.0)
    berth.look(np.array([0.5, 0.0, -3.1]), 0.2, 1.0)
    assert abs(berth.pose[2]) > 3.1


def test_parking_again_begins_anew():
    berth = Berth(Robot(), BerthConfig())
    moving = Motion(np.array([0.5]), np.zeros(1))
    for _ in range(2):
        berth.take(pose(0.02), 0.3, 1.0)
        berth.look(pose(-0.03), 0.2, 0.4)
        assert berth.step(moving).speed_mps > 0.0  # it creeps on
        assert berth.lowest == 0.2
        assert berth.most_doubt == pytest.approx(0.6)
        berth.carry((0.0, 0.0), REACH_M, 0.0)
        assert berth.step(moving).speed_mps == 0.0
