import numpy as np
import pytest

from cbe.errors import WorldError
from cbe.robot import Robot
from cbe_hil_sim.astar import SPACING_M, GoalField, plan
from cbe_hil_sim.clearance import Clearance
from cbe_hil_sim.column import ColumnBackend
from cbe_hil_sim.demonstrator import PathFollower, demonstrate, sample_routes, start_pose
from cbe_hil_sim.world import Surfaces, World
from cbe_hil_sim.worldbatch import WorldBatch

ROBOT = Robot()
TURNING_RADIUS_M = 1.0 / ROBOT.max_curvature_per_m


def two_rooms(door_cells=16):
    """7.1 x 4.1 m: two rooms, a wall between with a door of `door_cells` * 0.05 m, a table."""
    solid = np.zeros((82, 142), np.float32)
    solid[[0, -1]] = solid[:, [0, -1]] = 2.5
    solid[:, 70:72] = 2.5
    solid[50 : 50 + door_cells, 70:72] = 0.0
    solid[20:32, 20:40] = 0.7
    none, surface = np.zeros_like(solid), np.zeros(solid.shape, np.uint16)
    surfaces = Surfaces(
        np.zeros(1, np.int32),
        np.zeros((1, 3), np.float32),
        np.ones((1, 2), np.float32),
        np.ones((1, 3), np.float32),
    )
    textures = np.full((1, 128, 128, 3), 128, np.uint8)
    return World(
        solid, none, none, surface, surface, surface, surface, surface, 2.5, surfaces, textures,
        name="two rooms",
    )  # fmt: skip


WORLD = two_rooms()
START, GOAL = np.array([0.55, 0.8]), np.array([6.0, 0.8])


def test_path_joins_start_and_goal_in_even_steps_clear_of_obstacles():
    path = plan(WORLD, START, GOAL)
    assert path[0] == pytest.approx(START)
    assert path[-1] == pytest.approx(GOAL)
    steps = np.hypot(*np.diff(path, axis=0).T)
    assert steps == pytest.approx(SPACING_M, abs=0.01)
    assert WORLD.clearance_at(path).min() >= 0.2


def test_path_through_a_door_can_be_driven_by_the_car():
    path = plan(WORLD, START, GOAL)
    heading = np.unwrap(np.arctan2(*np.diff(path, axis=0).T[::-1]))
    curvature = np.abs(heading[6:] - heading[:-6]) / (6 * SPACING_M)
    assert curvature.max() < 1.0 / TURNING_RADIUS_M


def test_one_field_serves_many_starts():
    field = GoalField(WORLD, GOAL)
    for start in ([0.8, 0.8], [0.8, 3.2], [3.0, 2.0]):
        path = field.path(np.array(start))
        assert path[0] == pytest.approx(start)
        length = (len(path) - 1) * SPACING_M
        assert length <= field.cost_at(np.array([start]))[0] + 0.3


def test_closed_door_is_reported_with_the_world_name():
    with pytest.raises(WorldError, match="two rooms"):
        plan(two_rooms(door_cells=6), START, GOAL)


def test_goal_inside_furniture_is_refused():
    with pytest.raises(WorldError, match="goal"):
        plan(WORLD, START, np.array([1.5, 1.3]))


def test_sampled_routes_keep_length_and_clearance():
    routes = sample_routes(WORLD, 12, np.random.default_rng(0), 2.0, 5.0)
    assert len(routes) == 12
    for path in routes:
        assert 2.0 - SPACING_M <= (len(path) - 1) * SPACING_M <= 5.0 + SPACING_M
        assert WORLD.clearance_at(path).min() >= 0.17


def test_routes_longer_than_the_world_allows_are_refused():
    with pytest.raises(WorldError, match="0 of 1 routes"):
        sample_routes(WORLD, 1, np.random.default_rng(0), 40.0, 50.0)


def test_demonstrations_arrive_clear_of_everything():
    paths = sample_routes(WORLD, 12, np.random.default_rng(1), 2.0, 8.0)
    drives = demonstrate(WorldBatch.pack([WORLD]), [WORLD], np.zeros(12, int), paths, ROBOT)
    assert [drive.route for drive in drives] == list(range(12))
    for drive in drives:
        path = paths[drive.route]
        assert np.hypot(*(drive.poses[-1, :2] - path[-1])) < 0.2
        assert drive.poses[0] == pytest.approx(start_pose(path))
        assert drive.min_clearance_m > 0.05
        assert drive.speed_mps[0] == 0.0
        assert drive.speed_mps[-1] < 0.05
        assert len(drive.poses) == len(drive.speed_mps) == len(drive.steer_rad)
        assert drive.length_m == pytest.approx((len(path) - 1) * SPACING_M, rel=0.1, abs=0.2)


def test_drive_that_is_walled_in_is_left_out():
    path = plan(WORLD, np.array([2.6, 2.9]), np.array([4.5, 2.9]))
    shut = two_rooms(door_cells=0)
    drives = demonstrate(WorldBatch.pack([shut]), [shut], np.zeros(1, int), [path], ROBOT)
    assert drives == []


def test_waypoint_stays_on_its_branch_where_a_path_crosses_itself():
    angle = np.arange(0.0, 2.0 * np.pi, 0.05)
    loop = np.stack([np.sin(angle), np.sin(angle) * np.cos(angle)], axis=-1)  # figure of eight
    follower = PathFollower([loop])
    for k in range(0, len(loop), 2):
        follower.waypoint(np.array([[*loop[k], 0.0]]))
        assert abs(int(follower.closest[0]) - k) <= 1


def test_interpolated_clearance_is_the_distance_to_a_straight_wall():
    clearance = Clearance([WORLD, WORLD])
    x = np.array([0.3, 0.32, 0.345])
    found = clearance.at(np.array([0, 1, 0]), np.stack([x, np.full(3, 2.5)], axis=-1))
    assert found == pytest.approx(x - 0.05, abs=1e-5)


def test_column_backend_notes_a_collision_and_keeps_it():
    backend = ColumnBackend([WORLD], np.zeros(2, int))
    backend.reset(np.array([[3.2, 1.0, 0.0], [3.2, 1.0, np.pi]]))
    assert not backend.collided.any()
    for _ in range(20):
        backend.step(np.full(2, 0.5), np.zeros(2))
    assert backend.collided.tolist() == [True, False]
    backend.reset(np.array([[3.0, 1.0, 0.0], [3.2, 1.0, np.pi]]))
    assert not backend.collided.any()
    seen = backend.observe()
    assert seen.images.shape == (2, 64, 64, 3)
    assert seen.scans_m.shape == (2, ROBOT.scan_rays)


def test_column_backend_refuses_a_world_it_has_not():
    with pytest.raises(WorldError, match="1 worlds"):
        ColumnBackend([WORLD], np.array([1]))
