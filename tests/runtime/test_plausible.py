"""A camera that is covered or hangs stops the robot; a plain wall does not."""

import math

import numpy as np
import pytest

from cbe_runtime.observation import Frame
from cbe_runtime.plausible import RETRY_S, PictureWatch, ReturnWatch, brightness, is_blank
from cbe_runtime.state import Reason

OPEN = np.full(240, 3.0)
WALL = np.full(240, 0.3)
SCENE = (60 + np.arange(64 * 64 * 3) % 50).astype(np.uint8).reshape(64, 64, 3)


def plain(level):
    return np.full((64, 64, 3), level, np.uint8)


class Watched:
    """Shows a watch one picture each 0.1 s."""

    def __init__(self):
        self.watch = PictureWatch(fresh_s=0.3)
        self.steps = 0

    def show(self, image, ranges_m=OPEN, speed_mps=0.5):
        now_s = 10.0 + 0.1 * self.steps
        self.steps += 1
        frame = Frame(image, now_s, self.steps)
        return self.watch.fault(frame, image, ranges_m, speed_mps, now_s)

    def drive(self, steps):
        return [self.show(np.roll(SCENE, self.steps, axis=1)) for _ in range(steps)]


@pytest.fixture
def watched():
    watched = Watched()
    assert watched.drive(3) == [None] * 3
    return watched


@pytest.mark.parametrize("level", [0, 128, 255])
def test_picture_of_one_colour_stops_within_four_frames(watched, level):
    faults = [watched.show(plain(level)) for _ in range(5)]
    assert faults[0] is None
    assert faults[-1] is Reason.BLANK_IMAGE
    assert faults.index(Reason.BLANK_IMAGE) <= 3
    assert watched.drive(1) == [None]


def test_lens_that_is_half_covered_stops_until_it_is_free(watched):
    half = SCENE.copy()
    half[:, :32] = 0
    faults = [watched.show(np.roll(half, step, axis=0)) for step in range(5)]
    assert faults[0] is None
    assert faults[-1] is Reason.BLANK_IMAGE
    assert watched.drive(1) == [None]


def test_what_a_narrow_camera_never_sees_is_not_taken_for_covered():
    narrow = Watched()
    frame = plain(0)
    for step in range(5):
        frame[14:50, 10:54] = np.roll(SCENE, step, axis=1)[14:50, 10:54]
        assert narrow.show(frame.copy()) is None


def test_single_blank_picture_is_passed_over(watched):
    assert watched.show(plain(255)) is None
    assert not watched.watch.shows
    assert watched.drive(1) == [None]
    assert watched.watch.shows


def test_noise_of_a_covered_lens_is_no_picture():
    noise = np.random.default_rng(0).integers(0, 6, (64, 64, 3), np.uint8)
    assert is_blank(brightness(noise), wall=True)


def test_white_picture_of_a_narrow_camera_is_blank_for_all_its_black_border():
    image = plain(0)
    image[14:50, 10:54] = 255
    assert is_blank(brightness(image), wall=False)
    image[14:50, 10:54] = SCENE[14:50, 10:54]
    assert not is_blank(brightness(image), wall=False)


def test_overexposed_picture_with_a_door_in_it_is_not_blank():
    image = plain(255)
    image[20:44, 40:48] = 190  # 5 % of it
    assert not is_blank(brightness(image), wall=False)
    image[24:44] = 255
    assert is_blank(brightness(image), wall=False)


def test_plain_wall_right_ahead_never_stops_the_robot(watched):
    assert {watched.show(plain(200), WALL) for _ in range(100)} == {None}
    assert watched.watch.shows


def test_camera_covered_before_a_wall_stops_all_the_same(watched):
    assert [watched.show(plain(0), WALL) for _ in range(5)][-1] is Reason.BLANK_IMAGE


def test_picture_that_stands_still_while_driving_stops_and_is_tried_again(watched):
    still = [watched.show(SCENE, speed_mps=0.5) for _ in range(5)]
    assert still[-1] is Reason.FROZEN_CAMERA
    standing = [watched.show(SCENE, speed_mps=0.0) for _ in range(round(10 * RETRY_S) + 2)]
    assert standing[-1] is None
    assert standing.count(None) <= 3
    assert [watched.show(SCENE, speed_mps=0.5) for _ in range(5)][-1] is Reason.FROZEN_CAMERA
    assert watched.drive(1) == [None]


def test_still_scene_before_a_standing_robot_is_believed(watched):
    assert {watched.show(SCENE, speed_mps=0.0) for _ in range(50)} == {None}


def test_walls_do_not_vanish_all_at_once():
    watch = ReturnWatch()
    nothing = np.full(240, math.inf)
    assert watch.plausible(nothing)  # an open field
    assert watch.plausible(OPEN)
    assert not watch.plausible(nothing)
    assert not watch.plausible(nothing)
    assert watch.plausible(OPEN)


def test_walls_may_recede_out_of_reach():
    watch = ReturnWatch()
    receding = (np.where(np.arange(240) < 24 + n, math.inf, 6.9 + 0.02 * n) for n in range(60))
    assert all(watch.plausible(ranges_m) for ranges_m in receding)
    assert watch.plausible(np.full(240, math.inf))


@pytest.mark.parametrize("seed", range(3))
def test_no_plain_wall_of_a_generated_house_counts_as_blank(seed):
    column = pytest.importorskip("cbe_hil_sim.column")
    generate = pytest.importorskip("cbe_hil_sim.generate")
    world = generate.generate(generate.VALIDATION_SEEDS[seed])
    near = np.argwhere((world.clearance_m > 0.13) & (world.clearance_m < 0.6))
    rng = np.random.default_rng(seed)
    rows, columns = near[rng.integers(len(near), size=150)].T
    down, right = np.gradient(world.clearance_m)
    facing = np.arctan2(-down[rows, columns], -right[rows, columns]) + rng.normal(0.0, 0.4, 150)
    points = (np.stack([columns, rows], axis=-1) + 0.5) * world.resolution_m + world.origin_m
    backend = column.ColumnBackend([world], np.zeros(150, np.int64))
    backend.reset(np.column_stack([points, facing]))
    seen = backend.observe()
    blank = [
        PictureWatch(0.0).fault(Frame(image, 0.0, 1), image, ranges_m, 0.0, 1.0)
        for image, ranges_m in zip(seen.images, seen.scans_m.astype(np.float64), strict=True)
    ]
    assert set(blank) == {None}
