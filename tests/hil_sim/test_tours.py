"""Tours are as long as asked, whatever the size of their world."""

import numpy as np

from cbe.robot import Robot
from cbe_hil_sim.floorplan import FloorPlan, from_floorplan
from cbe_hil_sim.tours import roomy, tour


def test_small_world_is_toured_until_the_length_is_reached() -> None:
    plan = np.ones((80, 140), np.bool_)  # two rooms: no straight way is 10 m long
    plan[4:-4, 4:68] = plan[4:-4, 72:-4] = plan[30:50, 68:72] = False
    world = from_floorplan(FloorPlan(plan, 0.05))
    path = tour(world, np.random.default_rng(0), 10.0, roomy(world))
    assert path is not None
    assert np.hypot(*np.diff(path, axis=0).T).sum() >= 9.5
    assert world.clearance_at(path).min() > Robot().body_radius_m
