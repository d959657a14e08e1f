"""Tours are as long as asked, whatever the size of their world, and turn as a car can."""

import math

import numpy as np
import pytest

from cbe.robot import Robot
from cbe_hil_sim.floorplan import FloorPlan, from_floorplan
from cbe_hil_sim.tours import HAIRPIN_RAD, SHARPEST_RAD, roomy, tour


@pytest.fixture(scope="module")
def two_rooms():
    plan = np.ones((80, 140), np.bool_)  # no straight way is 10 m long
    plan[4:-4, 4:68] = plan[4:-4, 72:-4] = plan[30:50, 68:72] = False
    return from_floorplan(FloorPlan(plan, 0.05))


def sharpest_rad(path):
    """Largest turn between the 0.3 m before and after a point."""
    legs = path[6:] - path[:-6]
    heading = np.arctan2(legs[:, 1], legs[:, 0])
    turn = heading[6:] - heading[:-6]
    return np.abs((turn + math.pi) % (2.0 * math.pi) - math.pi).max()


def test_small_world_is_toured_until_the_length_is_reached(two_rooms):
    path = tour(two_rooms, np.random.default_rng(0), 10.0, roomy(two_rooms))
    assert path is not None
    assert np.hypot(*np.diff(path, axis=0).T).sum() >= 9.5
    assert two_rooms.clearance_at(path).min() > Robot().body_radius_m


def test_tour_turns_back_in_a_passage_only_where_asked_to(two_rooms):
    def sharpest(limit_rad):
        rng, places = np.random.default_rng(1), roomy(two_rooms)
        tours = [tour(two_rooms, rng, 8.0, places, limit_rad) for _ in range(12)]
        return max(sharpest_rad(path) for path in tours if path is not None)

    assert sharpest(SHARPEST_RAD) < SHARPEST_RAD + 0.2
    assert SHARPEST_RAD + 0.5 < sharpest(HAIRPIN_RAD) < HAIRPIN_RAD + 0.2
