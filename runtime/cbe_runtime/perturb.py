"""What may befall a camera between teaching and repeating: the same every time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Perturbation = Callable[[NDArray[np.uint8], int], NDArray[np.uint8]]

GAIN = 1.35
TURN_PX = 7  # about 21 deg
NOISE_LEVELS = 12.0


def as_it_is(image: NDArray[np.uint8], _step: int) -> NDArray[np.uint8]:
    """The view itself."""
    return image


def brighter(image: NDArray[np.uint8], _step: int) -> NDArray[np.uint8]:
    """As by a longer exposure, lights burnt out."""
    brightened: NDArray[np.uint8] = np.minimum(GAIN * image, 255.0).astype(np.uint8)
    return brightened


def darker(image: NDArray[np.uint8], _step: int) -> NDArray[np.uint8]:
    """As by a shorter exposure."""
    return (image / GAIN).astype(np.uint8)


def blurred(image: NDArray[np.uint8], _step: int) -> NDArray[np.uint8]:
    """Each pixel the mean of the 3 x 3 around it, as out of focus."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge").astype(np.uint16)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    total = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    mean: NDArray[np.uint8] = (total // 9).astype(np.uint8)
    return mean


def turned_left(image: NDArray[np.uint8], _step: int) -> NDArray[np.uint8]:
    """As if the robot looked to the left of its way; the edge is repeated."""
    padded: NDArray[np.uint8] = np.pad(image, ((0, 0), (TURN_PX, 0), (0, 0)), mode="edge")
    return padded[:, :-TURN_PX]


def turned_right(image: NDArray[np.uint8], _step: int) -> NDArray[np.uint8]:
    """As if the robot looked to the right of its way; the edge is repeated."""
    padded: NDArray[np.uint8] = np.pad(image, ((0, 0), (0, TURN_PX), (0, 0)), mode="edge")
    return padded[:, TURN_PX:]


def noisy(image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """As in bad light; every step has its own noise."""
    noise = np.random.default_rng(step).standard_normal(image.shape, np.float32)
    noised: NDArray[np.uint8] = np.clip(image + NOISE_LEVELS * noise, 0.0, 255.0).astype(np.uint8)
    return noised


PERTURBATIONS: dict[str, Perturbation] = {
    "turned_left": turned_left,
    "turned_right": turned_right,
    "brighter": brighter,
    "darker": darker,
    "blurred": blurred,
    "noisy": noisy,
}
