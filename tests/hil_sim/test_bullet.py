import numpy as np
import pytest

pytest.importorskip("pybullet")

from cbe.camera import CameraModel
from cbe.errors import CameraError, WorldError
from cbe.geometry import relative
from cbe.robot import STEP_S, Robot
from cbe_hil_sim.bullet import BulletBackend
from cbe_hil_sim.bulletscene import scene_from_world
from cbe_hil_sim.vehicle import Vehicle

TINY = CameraModel(16, 16, 4.62, 5.92, 8.0, 8.0)
START = np.array([[0.5, 2.0, 0.0]])


@pytest.fixture
def hall(make_room):
    """A bare room of 4 x 3 m from (-1, 0.5) with walls 0.1 m thick inside it."""
    with BulletBackend(scene_from_world(make_room()), camera=TINY) as backend:
        yield backend


def drive(backend, steps, speed, yaw_rate):
    for _ in range(steps):
        backend.step(np.array([speed]), np.array([yaw_rate]))


@pytest.mark.parametrize("curvature", [0.0, 0.8, -1.5, 2.3])
def test_same_commands_end_where_the_kinematic_bicycle_does(hall, curvature):
    hall.reset(START)
    vehicle = Vehicle(START)
    for speed in [0.3] * 10 + [0.5] * 15 + [0.0] * 5:
        command = np.array([speed]), np.array([speed * curvature])
        hall.step(*command)
        vehicle.step(*command)
    x, y, yaw = np.abs(relative(vehicle.poses, hall.poses)[0])
    driven_m = 1.0
    assert not hall.collided[0]
    assert np.hypot(x, y) < 0.03 * driven_m  # 0.3 to 1.5 cm measured
    assert yaw < 0.04


def test_speed_changes_within_the_robots_limits(hall):
    hall.reset(START)
    speeds = [0.0]
    for wanted in [0.5] * 6 + [0.0] * 5:
        drive(hall, 1, wanted, 0.0)
        speeds.append(hall.car.twist[0])
    robot, change = Robot(), np.diff(speeds)
    assert change.max() <= 1.05 * robot.max_acceleration_mps2 * STEP_S
    assert change.min() >= -1.05 * robot.max_braking_mps2 * STEP_S
    assert max(speeds) == pytest.approx(0.5, abs=0.01)
    assert abs(speeds[-1]) < 0.005


def test_steering_is_held_at_standstill(hall):
    hall.reset(START)
    drive(hall, 5, 0.4, 0.6)
    steer_rad = hall.car.steer_rad
    drive(hall, 5, 0.0, 0.0)
    assert steer_rad > 0.1
    assert hall.car.steer_rad == steer_rad


def test_wall_stops_the_body_and_is_noted_until_reset(hall):
    hall.reset(START)
    drive(hall, 80, 0.5, 0.0)
    assert hall.collided[0]
    assert hall.poses[0, 0] == pytest.approx(2.9 - Robot().body_radius_m, abs=0.01)
    hall.reset(START)
    assert not hall.collided[0]


def test_wheels_ahead_of_the_body_touch_no_wall(hall):
    hall.reset(np.array([[2.7, 2.0, 0.0]]))  # the front wheels reach 0.19 m ahead
    drive(hall, 2, 0.3, 0.0)
    assert not hall.collided[0]
    assert hall.car.twist[0] == pytest.approx(0.3, abs=0.02)


def test_body_starts_in_contact_where_it_is_put_into_a_wall(hall):
    hall.reset(np.array([[2.85, 2.0, 0.0]]))
    assert hall.collided[0]


def test_clearance_is_the_distance_from_the_body_to_the_wall(hall):
    hall.reset(np.array([[2.4, 2.0, 1.0]]))
    assert hall.clearance_m[0] == pytest.approx(2.9 - 2.4 - Robot().body_radius_m, abs=0.005)


def test_scan_measures_the_walls_and_never_the_robot(hall):
    hall.reset(START)
    robot = Robot()
    scan = hall.observe().scans_m[0]
    angle = robot.scan_angle_min_rad + np.arange(robot.scan_rays) * robot.scan_angle_increment_rad
    x, y = START[0, 0] + robot.scan_x_m, START[0, 1]
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(angle) > 0, 2.9 - x, x + 0.9) / np.abs(np.cos(angle))
        to_y = np.where(np.sin(angle) > 0, 3.4 - y, y - 0.6) / np.abs(np.sin(angle))
    assert np.abs(scan - np.minimum(to_x, to_y)).max() < 1e-3


def test_ray_without_return_is_infinite(make_room):
    world = make_room(40, 400)
    with BulletBackend(scene_from_world(world), camera=TINY) as backend:
        backend.reset(np.array([[4.0, 1.5, 0.0]]))
        scan = backend.observe().scans_m[0]
    assert np.isinf(scan[[119, 120]]).all()
    assert np.isfinite(scan[30])


def test_box_is_seen_scanned_and_hit(hall):
    hall.reset(START)
    before = hall.observe()
    red = np.full((4, 4, 3), (200, 0, 0), np.uint8)
    hall.place_box(np.array([1.5, 2.0, 0.0]), (0.3, 0.3, 1.0), red)
    after = hall.observe()
    ahead = Robot().scan_rays // 2
    assert after.scans_m[0, ahead] == pytest.approx(1.35 - 0.58, abs=0.005)
    assert after.scans_m[0, ahead] < before.scans_m[0, ahead]
    changed = (after.images[0] != before.images[0]).any(axis=-1)
    assert changed.any()
    assert (after.images[0][changed] == (200, 0, 0)).all()
    drive(hall, 30, 0.5, 0.0)
    assert hall.collided[0]


def test_table_edge_stops_the_mast_without_tipping_the_car(make_room):
    world = make_room()
    world.span_bottom_m[:, 50:] = 0.8
    world.span_top_m[:, 50:] = 0.85
    with BulletBackend(scene_from_world(world), camera=TINY) as backend:
        backend.reset(START)
        drive(backend, 40, 0.5, 0.0)
        assert backend.collided[0]
        assert backend.poses[0] == pytest.approx([1.5 - Robot().body_radius_m, 2.0, 0.0], abs=0.02)


def test_lintel_above_the_mast_lets_the_car_pass(make_room):
    world = make_room()
    world.span_bottom_m[:, 50:52] = 1.15
    world.span_top_m[:, 50:52] = 2.5
    with BulletBackend(scene_from_world(world), camera=TINY) as backend:
        backend.reset(START)
        drive(backend, 40, 0.5, 0.0)
        assert backend.poses[0, 0] > 2.0
        assert not backend.collided[0]


def test_two_backends_do_not_share_a_client(hall, make_room):
    hall.reset(START)
    with BulletBackend(scene_from_world(make_room()), camera=TINY) as other:
        other.reset(START)
        drive(other, 5, 0.5, 0.0)
    assert hall.poses[0] == pytest.approx(START[0])
    drive(hall, 5, 0.5, 0.0)
    assert hall.poses[0, 0] > START[0, 0]


def test_fisheye_camera_is_refused(make_room):
    fisheye = CameraModel(64, 64, 20.0, 20.0, 32.0, 32.0, "fisheye")
    with pytest.raises(CameraError, match="pinhole"):
        BulletBackend(scene_from_world(make_room()), camera=fisheye)


def test_pose_that_is_not_finite_is_refused(hall):
    with pytest.raises(WorldError, match="finite"):
        hall.reset(np.array([[np.nan, 0.0, 0.0]]))
