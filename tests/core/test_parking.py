import math

import numpy as np
import pytest

from cbe.controller import Motion, twist
from cbe.geometry import compose, relative
from cbe.parking import Parking
from cbe.robot import STEP_S, Robot

ROBOT = Robot()


def parked(rest, speed_mps=0.5):
    """Pose (3,) in which a robot that does what it is told comes to rest, and its speeds."""
    parking, pose = Parking(ROBOT), np.zeros(3)
    motion, speeds = Motion(np.array([speed_mps]), np.zeros(1)), [speed_mps]
    while motion.speed_mps[0] > 0.0:
        asked = parking.step(motion, relative(pose, np.array(rest)))
        turned = asked.steer_rad - motion.steer_rad
        most = ROBOT.max_steer_rate_rad_s * STEP_S
        braked = motion.speed_mps - ROBOT.max_braking_mps2 * STEP_S
        motion = Motion(
            np.maximum(asked.speed_mps, braked), motion.steer_rad + np.clip(turned, -most, most)
        )
        speed, yaw_rate = twist(motion, ROBOT)
        turn = yaw_rate[0] * STEP_S
        moved = [speed[0] * STEP_S * np.cos(turn / 2), speed[0] * STEP_S * np.sin(turn / 2), turn]
        pose = compose(pose, np.array(moved))
        speeds.append(float(speed[0]))
        assert len(speeds) < 100
    return pose, speeds


@pytest.mark.parametrize("ahead_m", [0.15, 0.3, 0.6, 0.85])
def test_what_lies_straight_ahead_is_met(ahead_m):
    pose, _ = parked([ahead_m, 0.0, 0.0])
    assert pose == pytest.approx([ahead_m, 0.0, 0.0], abs=0.03)


@pytest.mark.parametrize("turned_deg", [-45.0, -30.0, 30.0, 45.0])
@pytest.mark.parametrize("beside_m", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("ahead_m", [0.1, 0.4])
def test_place_and_heading_are_both_right_enough(ahead_m, beside_m, turned_deg):
    rest = np.array([ahead_m, beside_m, math.radians(turned_deg)])
    error = relative(parked(rest)[0], rest)
    assert math.hypot(error[0], error[1]) < 0.42
    assert abs(math.degrees(error[2])) < 20.0


def test_never_faster_than_before():
    _, speeds = parked([0.7, 0.1, 0.2], speed_mps=0.3)
    assert (np.diff(speeds) <= 1e-9).all()


def test_what_lies_behind_is_not_driven_to():
    pose, _ = parked([-0.2, 0.0, 0.0])
    assert np.hypot(*pose[:2]) < 0.12  # of which 0.06 m are needed to brake


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_pose_that_is_no_number_brakes(bad):
    motion = Parking(ROBOT).step(Motion(np.array([0.5]), np.array([0.1])), np.array([bad, 0, 0]))
    assert (motion.speed_mps[0], motion.steer_rad[0]) == (0.0, 0.1)
