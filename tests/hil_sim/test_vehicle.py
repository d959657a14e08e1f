import numpy as np
import pytest

from cbe.controller import Motion, twist
from cbe.robot import Robot
from cbe_hil_sim.vehicle import Vehicle

ROBOT = Robot()


def settled(speed, steer, robots=1, **options):
    """Vehicle that has driven one second under a constant command."""
    vehicle = Vehicle(np.zeros((robots, 3)), ROBOT, **options)
    command = twist(Motion(np.full(robots, speed), np.full(robots, steer)), ROBOT)
    for _ in range(10):
        vehicle.step(*command)
    return vehicle, command


def test_constant_steering_drives_a_circle_of_the_bicycle_radius():
    vehicle, command = settled(0.5, ROBOT.max_steer_rad)
    x, y, yaw = vehicle.poses[0]
    radius = 1.0 / ROBOT.max_curvature_per_m
    centre = np.array([x - radius * np.sin(yaw), y + radius * np.cos(yaw)])
    for _ in range(50):
        vehicle.step(*command)
        assert np.hypot(*(vehicle.poses[0, :2] - centre)) == pytest.approx(radius, abs=1e-3)


def test_speed_and_steering_change_within_their_limits():
    vehicle = Vehicle(np.zeros((1, 3)), ROBOT)
    vehicle.step(*twist(Motion(np.array([0.5]), np.array([0.36])), ROBOT))
    assert vehicle.speed_mps[0] == pytest.approx(0.15)
    assert vehicle.steer_rad[0] == pytest.approx(0.32)
    vehicle, _ = settled(0.5, 0.0)
    vehicle.step(np.zeros(1), np.zeros(1))
    assert vehicle.speed_mps[0] == pytest.approx(0.3)


def test_steering_is_held_while_standing():
    vehicle, _ = settled(0.5, 0.2)
    for _ in range(5):
        vehicle.step(np.zeros(1), np.ones(1))
    assert vehicle.steer_rad[0] == pytest.approx(0.2)
    assert vehicle.speed_mps[0] == 0.0


def test_commands_beyond_the_limits_are_clipped():
    vehicle = Vehicle(np.zeros((2, 3)), ROBOT)
    for _ in range(10):
        vehicle.step(np.array([3.0, -1.0]), np.array([9.0, 0.0]))
    assert vehicle.speed_mps.tolist() == pytest.approx([ROBOT.max_speed_mps, 0.0])
    assert vehicle.steer_rad[0] == pytest.approx(ROBOT.max_steer_rad)


def test_noise_scales_speed_around_the_command_within_its_bound():
    rng = np.random.default_rng(0)
    vehicle, _ = settled(0.2, 0.1, robots=4000, noise=0.5, rng=rng)
    # The last target lies in 0.2 * (1 +- 0.5); rate limits allow 0.15 and 0.2 a step.
    assert 0.1 - 1e-9 <= vehicle.speed_mps.min() < 0.12
    assert 0.28 < vehicle.speed_mps.max() <= 0.3 + 1e-9
    assert vehicle.speed_mps.mean() == pytest.approx(0.2, abs=0.005)
    assert vehicle.steer_rad.std() == pytest.approx(0.1 * 0.25, rel=0.15)


def test_same_seed_gives_the_same_noisy_drive():
    first, _ = settled(0.3, 0.1, robots=3, noise=1.0, rng=np.random.default_rng(7))
    second, _ = settled(0.3, 0.1, robots=3, noise=1.0, rng=np.random.default_rng(7))
    assert (first.poses == second.poses).all()


def test_noise_without_a_generator_is_refused():
    with pytest.raises(ValueError, match="rng"):
        Vehicle(np.zeros((1, 3)), ROBOT, noise=0.5)


def test_kept_cars_go_on_unchanged():
    vehicle, command = settled(0.5, 0.1, robots=3)
    before = vehicle.poses.copy()
    vehicle.keep(np.array([True, False, True]))
    assert (vehicle.poses == before[[0, 2]]).all()
    vehicle.step(command[0][:2], command[1][:2])
    assert vehicle.poses.shape == (2, 3)
