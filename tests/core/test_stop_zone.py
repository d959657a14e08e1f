import numpy as np
import pytest

from cbe import stop_zone
from cbe.controller import Motion
from cbe.robot import STEP_S, Robot
from cbe.stop_zone import limit

ROBOT = Robot()


def scan_of(points):
    """Scan (1, 240) of thin poles at base_link points."""
    angle = ROBOT.scan_angle_min_rad + ROBOT.scan_angle_increment_rad * np.arange(ROBOT.scan_rays)
    scan = np.full((1, ROBOT.scan_rays), np.inf, np.float32)
    for x, y in points:
        dx = x - ROBOT.scan_x_m
        along = dx * np.cos(angle) + y * np.sin(angle)
        across = dx * np.sin(angle) - y * np.cos(angle)
        seen = (along > 0.0) & (np.abs(across) < 0.01)
        scan[0, seen] = np.minimum(scan[0, seen], along[seen])
    return scan


def allowed(speed, steer, scan):
    motion = limit(Motion(np.array([speed]), np.array([steer])), scan, ROBOT)
    return float(motion.speed_mps[0])


def test_free_way_leaves_the_command_alone():
    motion = limit(Motion(np.array([0.5]), np.array([0.2])), scan_of([]), ROBOT)
    assert motion.speed_mps[0] == 0.5
    assert motion.steer_rad[0] == 0.2


@pytest.mark.parametrize("gap_m", [0.16, 0.2, 0.25, 0.3])
def test_braking_after_one_unanswered_step_ends_before_the_obstacle(gap_m):
    scan = scan_of([(gap_m, 0.0)])
    speed = allowed(0.5, 0.0, scan)
    stopping = speed * STEP_S + speed**2 / (2.0 * ROBOT.max_braking_mps2)
    assert stopping < gap_m - ROBOT.body_radius_m
    assert speed < 0.5


def test_obstacle_on_the_arc_slows_and_beside_it_does_not():
    right = scan_of([(0.2, -0.125)])
    assert allowed(0.5, 0.0, right) < 0.46
    assert allowed(0.5, 0.36, right) == 0.5


def test_steering_away_frees_a_robot_close_to_a_wall():
    wall = scan_of([(x, -0.14) for x in np.arange(-0.05, 2.0, 0.02)])
    assert allowed(0.3, -0.2, wall) <= 0.1
    assert allowed(0.3, 0.36, wall) > 0.05


def test_touching_obstacle_ahead_stops():
    assert allowed(0.5, 0.0, scan_of([(0.125, 0.0)])) == 0.0


def test_scan_without_any_valid_ray_stops():
    assert allowed(0.5, 0.0, np.full((1, ROBOT.scan_rays), np.nan, np.float32)) == 0.0


def test_single_invalid_rays_do_not_stop():
    scan = scan_of([])
    scan[0, ::7] = np.nan
    assert allowed(0.5, 0.0, scan) == 0.5


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_command_stops(bad):
    assert allowed(bad, 0.0, scan_of([])) == 0.0
    motion = limit(Motion(np.array([0.3]), np.array([bad])), scan_of([]), ROBOT)
    assert motion.speed_mps[0] == 0.0
    assert np.isfinite(motion.steer_rad[0])


def test_speed_is_never_raised_nor_made_negative():
    assert allowed(0.05, 0.0, scan_of([])) == 0.05
    assert allowed(-0.3, 0.0, scan_of([])) == 0.0


def test_robots_of_a_batch_do_not_affect_each_other():
    scans = np.concatenate([scan_of([]), scan_of([(0.2, 0.0)])])
    motion = limit(Motion(np.full(2, 0.5), np.zeros(2)), scans, ROBOT)
    assert motion.speed_mps[0] == 0.5
    assert motion.speed_mps[1] < 0.3


def test_scan_out_of_reach_is_passed_over_only_where_it_allows_everything(monkeypatch):
    rng = np.random.default_rng(0)
    cases = []
    for _ in range(2000):
        scan = rng.uniform(rng.choice([0.05, 0.3, 0.39]), rng.choice([0.5, 1.0, 8.0]), (2, 240))
        scan[rng.random(scan.shape) < rng.choice([0.0, 0.01, 1.0], p=[0.6, 0.39, 0.01])] = (
            rng.choice([np.nan, np.inf, 0.0, -1.0])
        )
        speed = rng.uniform(0.0, 0.6, 2) * rng.choice([1.0, 1.0, 1.0, -1.0, np.nan])
        cases.append((Motion(speed, rng.uniform(-0.38, 0.38, 2)), scan))
    passed_over = sum(stop_zone._out_of_reach(*case, ROBOT) for case in cases)
    assert 200 < passed_over < 1500
    shortcut = [limit(*case, ROBOT) for case in cases]
    monkeypatch.setattr(stop_zone, "_out_of_reach", lambda *_: False)
    for short, case in zip(shortcut, cases, strict=True):
        whole = limit(*case, ROBOT)
        np.testing.assert_array_equal(short.speed_mps, whole.speed_mps)
        np.testing.assert_array_equal(short.steer_rad, whole.steer_rad)


def test_robot_whose_scan_says_nothing_stops_beside_one_with_a_free_way():
    scans = np.concatenate([np.full((1, ROBOT.scan_rays), np.nan), scan_of([])])
    motion = limit(Motion(np.full(2, 0.5), np.zeros(2)), scans, ROBOT)
    assert motion.speed_mps.tolist() == [0.0, 0.5]
