import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cbe.controller import Motion
from cbe.robot import Robot
from cbe_runtime.caution import allowed_share, slowed

ROBOT = Robot()
FULL = Motion(np.array([0.5]), np.array([0.2]))


@pytest.mark.parametrize(
    ("age_s", "share"),
    [(0.0, 1.0), (0.1, 1.0), (0.12, 1.0), (0.21, 0.5), (0.3, 0.0), (0.4, 0.0), (np.inf, 0.0)],
)
def test_share_falls_from_a_normal_age_to_zero_at_the_limit(age_s, share):
    assert allowed_share(age_s, fresh_s=0.3) == pytest.approx(share)


@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2).map(sorted))
def test_older_is_never_faster(ages_s):
    younger, older = (allowed_share(age_s, fresh_s=0.3) for age_s in ages_s)
    assert 0.0 <= older <= younger <= 1.0


def test_speed_falls_no_faster_than_the_robot_brakes():
    assert slowed(FULL, 0.5, 0.3, 0.3, ROBOT).speed_mps == pytest.approx(0.3)
    assert slowed(FULL, 0.3, 0.3, 0.3, ROBOT).speed_mps == pytest.approx(0.1)
    assert slowed(FULL, 0.1, 0.3, 0.3, ROBOT).speed_mps == 0.0


def test_steering_and_a_slower_command_stay_as_they_are():
    slow = Motion(np.array([0.1]), np.array([0.2]))
    assert slowed(slow, 0.1, 0.21, 0.3, ROBOT) == slow
    assert slowed(FULL, 0.3, 0.21, 0.3, ROBOT).steer_rad == 0.2
