"""Column and pybullet views of one world, held together.

Measures: scans, 95th percentile of the absolute difference; images, after area-resizing both to
the networks' 64 x 64, median absolute difference of channels and correlation.
"""

import cv2
import numpy as np
import pytest

pytest.importorskip("pybullet")

from cbe.robot import Robot
from cbe_hil_sim.bullet import SIM_CAMERA, BulletBackend
from cbe_hil_sim.bulletscene import scene_from_world
from cbe_hil_sim.column import ColumnBackend
from cbe_hil_sim.generate import TEST_SEEDS, generate


def observations(world, count, seed):
    """Both backends' observations at `count` random free poses."""
    column = ColumnBackend([world], np.zeros(1, np.int64), camera=SIM_CAMERA)
    rng = np.random.default_rng(seed)
    free = np.argwhere(world.clearance_m > 0.25)[:, ::-1]
    with BulletBackend(scene_from_world(world)) as bullet:
        for place in rng.choice(free, count):
            xy = (place + rng.uniform(0.2, 0.8, 2)) * world.resolution_m + world.origin_m
            pose = np.array([[*xy, rng.uniform(-np.pi, np.pi)]])
            column.reset(pose)
            bullet.reset(pose)
            yield column, bullet


def compare_images(column, bullet):
    """Median absolute difference and correlation of the networks' views."""
    views = [
        cv2.resize(backend.observe().images[0], (64, 64), interpolation=cv2.INTER_AREA)
        for backend in (column, bullet)
    ]
    one, two = (view.astype(np.float64).ravel() for view in views)
    return np.median(np.abs(one - two)), np.corrcoef(one, two)[0, 1]


def compare_scans(column, bullet):
    """Share of rays that differ by more than 1 mm, and the 95th percentile of differences."""
    one, two = (backend.observe().scans_m[0] for backend in (column, bullet))
    with np.errstate(invalid="ignore"):
        difference = np.where(one == two, 0.0, np.abs(one - two))
    return (difference > 1e-3).mean(), np.percentile(difference, 95)


@pytest.fixture(params=["furnished", "generated"])
def world(request, make_room):
    if request.param == "furnished":
        return make_room(furnished=True)
    return generate(TEST_SEEDS[0])


def test_scans_agree_to_a_millimetre_but_at_edges(world):
    differing, worst_m = zip(
        *(compare_scans(*pair) for pair in observations(world, 10, 1)), strict=True
    )
    assert max(worst_m) < 1e-3
    assert np.mean(differing) < 0.01


def test_images_agree(world):
    median, correlation = zip(
        *(compare_images(*pair) for pair in observations(world, 10, 2)), strict=True
    )
    assert max(median) <= 4.0
    assert np.mean(median) <= 2.0
    assert np.mean(correlation) > 0.96
    assert min(correlation) > 0.9


def test_clearance_agrees_to_a_cell(world):
    for column, bullet in observations(world, 10, 3):
        near = min(float(bullet.clearance_m[0]), 1.0)
        # The grid's distance is between cells' centres, the body's in three dimensions.
        assert near == pytest.approx(min(float(column.clearance_m[0]), 1.0), abs=0.05)


def test_every_surface_keeps_its_colour(make_room):
    world = make_room(furnished=True)
    flat = np.broadcast_to(
        world.textures.mean(axis=(1, 2), keepdims=True), world.textures.shape
    ).astype(np.uint8)
    world.textures[:] = flat
    for column, bullet in observations(world, 8, 4):
        one, two = (backend.observe().images[0].astype(int) for backend in (column, bullet))
        # Edges apart, where the column view is antialiased.
        same = (np.abs(one - two).max(axis=-1) <= 2).mean()
        assert same > 0.95


def test_blocked_and_collided_agree_in_a_doorway(make_room):
    world = make_room(furnished=True)
    with BulletBackend(scene_from_world(world)) as bullet:
        bullet.reset(np.array([[1.0, 2.55, 0.0]]))
        for _ in range(20):
            bullet.step(np.array([0.5]), np.array([0.0]))
        assert not bullet.collided[0]
        assert bullet.poses[0, 0] > 1.5 + Robot().body_radius_m
