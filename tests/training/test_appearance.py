"""Randomised cameras."""

from dataclasses import replace

import numpy as np

from cbe_training import appearance


def test_black_borders_are_black_and_the_rest_is_not() -> None:
    rng = np.random.default_rng(0)
    cameras = appearance.sample(rng, 1, 1.0)
    border = np.array([[5, 3]])
    cameras = replace(cameras, border=border, noise=np.zeros(1, np.float32))
    image = np.full((1, 64, 64, 3), 200, np.uint8)
    seen = appearance.apply(cameras, image, rng)[0]
    assert seen[:3].max() == 0
    assert seen[:, -5:].max() == 0
    assert seen[3:-3, 5:-5].min() > 0


def test_a_repeated_look_differs_less_than_another_camera() -> None:
    rng = np.random.default_rng(1)
    cameras = appearance.sample(rng, 200, 1.0)
    again = appearance.vary(rng, cameras)
    same = np.abs(again.tone.astype(int) - cameras.tone).mean()
    other = np.abs(np.roll(cameras.tone, 1, axis=0).astype(int) - cameras.tone).mean()
    assert same < 0.5 * other


def test_images_depend_on_the_generator_alone() -> None:
    cameras = appearance.sample(np.random.default_rng(2), 4, 1.0)
    image = np.random.default_rng(3).integers(0, 255, (4, 64, 64, 3), dtype=np.uint8)
    first = appearance.apply(cameras, image, np.random.default_rng(4))
    second = appearance.apply(cameras, image, np.random.default_rng(4))
    np.testing.assert_array_equal(first, second)
