"""Starts as the paper's evaluation draws and keeps them."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from cbe.robot import Robot
from cbe_bench.jitter import (
    CLEARANCE_M,
    JITTER_LIMIT_M,
    JITTER_M,
    JITTER_RAD,
    MIN_OVERLAP,
    jittered,
    view_overlap,
)
from cbe_hil_sim.world import Surfaces, World
from cbe_hil_sim.worldbatch import WorldBatch

CELL_M = 0.05
MIDDLE = np.array([4.0, 2.0, 0.0])


def hall() -> World:
    """Return an empty hall of 8 x 4 m, with a wall across it from x = 6 m, open below y = 2 m."""
    shape = (80, 160)
    solid, none = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    solid[[0, -1]] = solid[:, [0, -1]] = solid[40:, 120] = 2.5
    kind = np.zeros(shape, np.uint16)
    one = np.ones((1, 3), np.float32)
    surfaces = Surfaces(np.zeros(1, np.int32), one, one[:, :2], one)
    return World(
        solid, none, none, kind, kind, kind, kind, kind, 2.5, surfaces,
        np.zeros((1, 128, 128, 3), np.uint8), origin_m=(0.0, 0.0), resolution_m=CELL_M,
    )  # fmt: skip


def turned(turn_rad: float) -> NDArray[np.float64]:
    """Return the pose in the middle, turned."""
    return MIDDLE + np.array([0.0, 0.0, turn_rad])


@pytest.fixture(scope="module")
def place():
    world = hall()
    return world, WorldBatch.pack([world])


def test_view_overlaps_itself_and_not_the_one_behind(place) -> None:
    _, batch = place
    assert min(view_overlap(batch, MIDDLE, MIDDLE)) == 1.0
    assert max(view_overlap(batch, MIDDLE, turned(math.pi))) == 0.0


def test_turned_view_overlaps_as_far_as_the_columns_do(place) -> None:
    _, batch = place
    half, turn = math.radians(60.0), math.radians(30.0)
    share = (math.tan(half) + math.tan(half - turn)) / (2.0 * math.tan(half))  # of the columns
    for overlap in view_overlap(batch, MIDDLE, turned(turn)):
        assert overlap == pytest.approx(share, abs=0.05)


def test_what_a_wall_hides_does_not_overlap(place) -> None:
    _, batch = place
    here, behind = np.array([5.0, 3.0, 0.0]), np.array([6.6, 3.0, 0.0])
    assert max(view_overlap(batch, here, behind)) < 0.1


def test_view_close_to_a_wall_holds_little_of_one_from_afar(place) -> None:
    _, batch = place
    far, near = np.array([1.0, 3.0, 0.0]), np.array([5.8, 3.0, 0.0])
    of_far, of_near = view_overlap(batch, far, near)
    assert of_far < 0.3 < 0.6 < of_near


def test_starts_have_room_a_like_view_and_the_papers_spread(place) -> None:
    world, batch = place
    rng = np.random.default_rng(0)
    drawn = [jittered(world, batch, MIDDLE, 1.0, rng) for _ in range(200)]
    starts = np.array(drawn, np.float64)
    off = np.hypot(*(starts - MIDDLE)[:, :2].T)
    assert 0.0 < off.max() <= JITTER_LIMIT_M
    assert np.std(starts[:, 0] - MIDDLE[0]) == pytest.approx(JITTER_M, rel=0.2)
    assert np.std(starts[:, 2]) == pytest.approx(JITTER_RAD, rel=0.2)
    for start in starts:
        assert min(view_overlap(batch, start, MIDDLE)) >= MIN_OVERLAP
    assert world.clearance_at(starts[:, :2]).min() > Robot().body_radius_m + CLEARANCE_M


def test_no_start_faces_a_wall_that_it_cannot_turn_from(place) -> None:
    world, batch = place
    rng = np.random.default_rng(1)
    pose = np.array([5.4, 3.2, 0.0])  # 0.6 m from the wall across
    for _ in range(50):
        start = jittered(world, batch, pose, 1.0, rng)
        assert start is not None
        ahead = start[:2] + 0.5 * np.array([math.cos(start[2]), math.sin(start[2])])
        assert world.clearance_at(ahead) > 0.0


def test_without_room_there_is_no_start(place) -> None:
    world, batch = place
    cornered = np.array([5.9, 3.9, 0.8])
    assert jittered(world, batch, cornered, 0.1, np.random.default_rng(0)) is None


def test_at_scale_zero_the_start_is_the_pose(place) -> None:
    world, batch = place
    start = jittered(world, batch, MIDDLE, 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(start, MIDDLE)
