import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cbe.arc import along_and_across
from cbe.controller import Motion, RmpController, motion_from_twist, twist
from cbe.robot import STEP_S, Robot

ROBOT = Robot()
CONTROLLER = RmpController(ROBOT)
ANGLE = ROBOT.scan_angle_min_rad + ROBOT.scan_angle_increment_rad * np.arange(ROBOT.scan_rays)


def scan_of_disc(x, y, radius, pose=(0.0, 0.0, 0.0)):
    """Scan (1, 240) of one world disc from a world pose of base_link."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = x - pose[0], y - pose[1]
    px, py = cos * dx + sin * dy - ROBOT.scan_x_m, cos * dy - sin * dx
    along = px * np.cos(ANGLE) + py * np.sin(ANGLE)
    across = px * np.sin(ANGLE) - py * np.cos(ANGLE)
    half = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    hit = (np.abs(across) < radius) & (along > half)
    return np.where(hit, along - half, np.inf)[None].astype(np.float32)


def drive(path, disc=None, steps=100):
    """Trace (T, 5) x, y, yaw, speed, steering of an ideal car led along x = 0.55 m ahead."""
    pose, motion = np.zeros(3), Motion(np.zeros(1), np.zeros(1))
    trace = []
    for _ in range(steps):
        trace.append([*pose, motion.speed_mps[0], motion.steer_rad[0]])
        target = path(pose)
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        d = target - pose[:2]
        waypoint = np.array([[cos * d[0] + sin * d[1], cos * d[1] - sin * d[0]]])
        scan = np.full((1, 240), np.inf, np.float32) if disc is None else scan_of_disc(*disc, pose)
        motion = CONTROLLER.step(motion, waypoint, scan)
        speed, yaw_rate = twist(motion, ROBOT)
        for _ in range(10):
            pose[0] += speed[0] * np.cos(pose[2]) * STEP_S / 10
            pose[1] += speed[0] * np.sin(pose[2]) * STEP_S / 10
            pose[2] += yaw_rate[0] * STEP_S / 10
    return np.array(trace)


def straight(end_m):
    return lambda pose: np.array([min(pose[0] + 0.55, end_m), 0.0])


def test_straight_drive_stops_at_its_end():
    trace = drive(straight(2.0))
    assert np.hypot(*(trace[-1, :2] - [2.0, 0.0])) < 0.05
    assert trace[-1, 3] == 0.0
    assert trace[:, 3].max() == pytest.approx(ROBOT.max_speed_mps)
    assert np.abs(trace[:, 4]).max() < 0.02


def test_speed_falls_smoothly_before_the_end():
    speed = drive(straight(2.0))[:, 3]
    assert np.diff(speed).min() >= -ROBOT.max_braking_mps2 * STEP_S - 1e-9
    assert (np.diff(speed[speed.argmax() + 10 :]) <= 1e-9).all()


def test_waypoint_beside_calls_for_full_lock():
    motion = Motion(np.full(2, 0.3), np.zeros(2))
    free = np.full((2, 240), np.inf)
    for _ in range(4):
        motion = CONTROLLER.step(motion, np.array([[0.05, 0.4], [-0.3, -0.3]]), free)
    assert motion.steer_rad[0] == pytest.approx(ROBOT.max_steer_rad, abs=0.02)
    assert motion.steer_rad[1] == pytest.approx(-ROBOT.max_steer_rad, abs=0.02)


def test_circle_above_the_turning_radius_is_followed():
    radius = 0.6

    def ahead(pose):
        angle = np.arctan2(pose[0], radius - pose[1]) + 0.5 / radius
        return np.array([radius * np.sin(angle), radius - radius * np.cos(angle)])

    trace = drive(ahead)[15:]
    assert np.abs(np.hypot(trace[:, 0], trace[:, 1] - radius) - radius).max() < 0.03
    assert np.abs(np.diff(trace[:, 4])).max() < 0.03


@pytest.mark.parametrize("offset_m", [0.0, 0.075, -0.15, 0.225])
def test_bin_on_or_beside_the_path_is_passed_without_contact(offset_m):
    trace = drive(straight(4.0), disc=(2.0, offset_m, 0.15), steps=130)
    clearance = np.hypot(trace[:, 0] - 2.0, trace[:, 1] - offset_m) - 0.15 - ROBOT.body_radius_m
    assert clearance.min() > 0.04
    assert np.hypot(*(trace[-1, :2] - [4.0, 0.0])) < 0.1


@pytest.mark.parametrize(("gap_m", "creeps"), [(0.28, True), (0.25, False)])
def test_gap_barely_wider_than_the_robot_is_crept_into(gap_m, creeps):
    apart, before = 0.5 * gap_m + 0.3, (1.38, 0.0, 0.0)
    scan = np.minimum(scan_of_disc(1.5, apart, 0.3, before), scan_of_disc(1.5, -apart, 0.3, before))
    motion = CONTROLLER.step(Motion(np.zeros(1), np.zeros(1)), np.array([[0.55, 0.0]]), scan)
    assert (0.05 < motion.speed_mps[0] <= 0.1) if creeps else motion.speed_mps[0] == 0.0


def test_wall_across_the_way_stops_the_robot():
    trace = drive(straight(4.0), disc=(4.0, 0.0, 2.0), steps=120)
    assert np.hypot(trace[:, 0] - 4.0, trace[:, 1]).min() > 2.0 + ROBOT.body_radius_m


@settings(max_examples=60, deadline=None)
@given(
    arrays(np.float64, (3, 2), elements=st.floats(-2, 2) | st.sampled_from([np.nan, np.inf])),
    arrays(np.float32, (3, 240), elements=st.sampled_from([0.0, 0.1, 0.5, 2.0, np.nan, np.inf])),
    arrays(np.float64, 3, elements=st.floats(0.0, 0.5)),
    arrays(np.float64, 3, elements=st.floats(-0.36, 0.36)),
)
def test_any_input_gives_a_command_within_the_limits(waypoint, scan, speed, steer):
    motion = CONTROLLER.step(Motion(speed, steer), waypoint, scan)
    assert ((motion.speed_mps >= 0.0) & (motion.speed_mps <= ROBOT.max_speed_mps)).all()
    assert (np.abs(motion.steer_rad) <= ROBOT.max_steer_rad).all()
    assert (motion.speed_mps - speed <= ROBOT.max_acceleration_mps2 * STEP_S + 1e-9).all()
    assert (speed - motion.speed_mps <= ROBOT.max_braking_mps2 * STEP_S + 1e-9).all()
    assert (np.abs(motion.steer_rad - steer) <= ROBOT.max_steer_rate_rad_s * STEP_S + 1e-9).all()


def test_batched_and_single_robots_get_the_same_commands():
    rng = np.random.default_rng(0)
    waypoint, scan = rng.uniform(-0.5, 0.7, (20, 2)), rng.uniform(0.3, 4.0, (20, 240))
    motion = Motion(rng.uniform(0, 0.5, 20), rng.uniform(-0.36, 0.36, 20))
    together = CONTROLLER.step(motion, waypoint, scan)
    for b in range(20):
        one = slice(b, b + 1)
        alone = CONTROLLER.step(
            Motion(motion.speed_mps[one], motion.steer_rad[one]), waypoint[one], scan[one]
        )
        assert alone.speed_mps[0] == pytest.approx(together.speed_mps[b], abs=1e-6)
        assert alone.steer_rad[0] == pytest.approx(together.steer_rad[b], abs=1e-6)


def test_waypoint_that_is_not_finite_brakes():
    motion = Motion(np.array([0.5]), np.array([0.0]))
    scan = np.full((1, 240), np.inf)
    slower = CONTROLLER.step(motion, np.array([[np.nan, 0.0]]), scan)
    assert slower.speed_mps[0] == pytest.approx(0.5 - ROBOT.max_braking_mps2 * STEP_S)


@given(st.floats(0.05, 0.5), st.floats(-0.36, 0.36))
def test_twist_and_back_is_the_same_motion(speed, steer):
    motion = Motion(np.array([speed]), np.array([steer]))
    back = motion_from_twist(*twist(motion, ROBOT), np.array([9.9]), ROBOT)
    assert back.steer_rad[0] == pytest.approx(steer, abs=1e-9)
    assert back.speed_mps[0] == speed


def test_steering_is_held_at_standstill():
    held = motion_from_twist(np.zeros(1), np.array([1.0]), np.array([0.2]), ROBOT)
    assert held.steer_rad[0] == 0.2


@given(st.floats(-2.3, 2.3), st.floats(0.05, 1.0), st.floats(-0.3, 0.3))
def test_arc_coordinates_are_recovered(curvature, along, across):
    # A point `across` to the left of the place reached after `along` metres.
    angle = curvature * along
    x = along if abs(curvature) < 1e-6 else np.sin(angle) / curvature
    y = 0.0 if abs(curvature) < 1e-6 else (1.0 - np.cos(angle)) / curvature
    point = np.array([x - across * np.sin(angle), y + across * np.cos(angle)])
    found_along, found_across = along_and_across(point, np.array(curvature))
    assert found_across == pytest.approx(abs(across), abs=1e-3)
    assert found_along == pytest.approx(along, abs=1e-3)
