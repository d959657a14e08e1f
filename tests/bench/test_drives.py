"""Drives lead from one room to another where there are rooms, and are about as long as asked."""

import numpy as np
import pytest

from cbe.errors import ConfigError
from cbe.robot import Robot
from cbe_bench.drives import Journeys
from cbe_bench.rooms import rooms
from cbe_hil_sim.floorplan import FloorPlan, from_floorplan
from cbe_hil_sim.generate import VALIDATION_SEEDS, generate


def length_m(path):
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def world_of(occupied):
    return from_floorplan(FloorPlan(occupied, 0.05))


@pytest.fixture(scope="module")
def two_rooms():
    """Two rooms of about 3.2 x 3.6 m joined by a door of 1 m."""
    plan = np.ones((80, 140), np.bool_)
    plan[4:-4, 4:68] = plan[4:-4, 72:-4] = plan[30:50, 68:72] = False
    return world_of(plan)


@pytest.fixture(scope="module")
def hall():
    """One room of 9 x 3 m."""
    plan = np.ones((68, 188), np.bool_)
    plan[4:-4, 4:-4] = False
    return world_of(plan)


def test_rooms_are_parted_by_the_door_between_them(two_rooms) -> None:
    room = rooms(two_rooms)
    assert set(np.unique(room)) == {0, 1, 2}
    columns = [np.flatnonzero((room == number).any(axis=0)) for number in (1, 2)]
    assert columns[0].max() < columns[1].min()
    assert not room[two_rooms.blocked].any()


def test_furniture_parts_no_rooms() -> None:
    world = generate(VALIDATION_SEEDS[0])
    low = (world.solid_top_m > 0.0) & (world.solid_top_m < 0.5 * world.ceiling_m)
    room = rooms(world)
    assert low.any()
    assert 2 < room.max() < 40
    labels = np.unique(room[room > 0])
    assert all(np.ptp(np.argwhere(room == label), axis=0).min() >= 3 for label in labels)


def test_one_large_space_is_one_room(hall) -> None:
    assert set(np.unique(rooms(hall))) == {0, 1}


def test_narrow_passage_is_no_room() -> None:
    plan = np.ones((28, 100), np.bool_)
    plan[4:-4, 4:-4] = False  # 1 m wide
    assert not rooms(world_of(plan)).any()


@pytest.mark.parametrize("seed", range(3))
def test_journey_leads_to_another_room(two_rooms, seed) -> None:
    path = Journeys(4.5).path(two_rooms, np.random.default_rng(seed))
    assert path is not None
    start, goal = rooms(two_rooms)[two_rooms.cells(path[[0, -1]])]
    assert {start, goal} == {1, 2}
    assert abs(length_m(path) - 4.5) < 0.25 * 4.5
    assert two_rooms.clearance_at(path).min() > Robot().body_radius_m


def test_journey_longer_than_the_world_is_a_tour_of_that_length(two_rooms) -> None:
    path = Journeys(14.0).path(two_rooms, np.random.default_rng(0))
    assert path is not None
    start, goal = rooms(two_rooms)[two_rooms.cells(path[[0, -1]])]
    assert start != goal
    assert abs(length_m(path) - 14.0) < 0.25 * 14.0


def test_world_of_one_room_is_driven_within_it(hall) -> None:
    path = Journeys(5.0).path(hall, np.random.default_rng(0))
    assert path is not None
    assert abs(length_m(path) - 5.0) < 0.25 * 5.0


def test_drive_in_circles_is_not_taken() -> None:
    rng = np.random.default_rng(0)
    straight = np.zeros((101, 3))
    straight[:, 0] = 0.05 * np.arange(101)
    assert Journeys(5.0).part(straight, rng) is straight
    assert Journeys(4.0).part(straight, rng) is None


@pytest.mark.parametrize("length", [0.0, -20.0, float("inf"), float("nan")])
def test_length_that_is_none_is_refused(length) -> None:
    with pytest.raises(ConfigError, match="at least 1 m long"):
        Journeys(length)
