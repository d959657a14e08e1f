"""Groups of views of one place from nearby poses, for learning how views relate.

Related pose by pose, M views make M (M - 1) examples, and groups differ where a rollout's frames
all look alike: attractors learn from them many times faster than from rollouts.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cbe import geometry
from cbe.robot import Robot
from cbe_training import appearance
from cbe_training.drives import Drives
from cbe_training.rollout import ALIASED, photograph

GROUP = 6
AHEAD_STEPS = 40  # views lie up to 2 m further along the drive
NOT_AHEAD = 0.4  # share of views at the group's first pose
JITTER_M, JITTER_RAD = 0.3, 0.25
MOST_JITTER = 1.6
MOVING = 2  # views of a group that also have the frame before
LONGEST_STEP_M = 0.15  # three steps at full speed
CURVATURE_PER_M = 2.3  # the vehicle's tightest
NOW, TARGET = np.nonzero(~np.eye(GROUP, dtype=np.bool_))  # all ordered pairs of a group


@dataclass(frozen=True, slots=True)
class Views:
    """G groups of views."""

    images: NDArray[np.uint8]  # (G * GROUP, 64, 64, 3)
    before: NDArray[np.uint8]  # (G * MOVING, 64, 64, 3) the frames before each group's first views
    relation: NDArray[np.float64]  # (G, len(NOW), 3) pose of TARGET in the frame of NOW
    motion: NDArray[np.float64]  # (G * MOVING, 3) pose of the view in the frame before


def draw(drives: Drives, count: int, rng: np.random.Generator) -> Views:
    """Draw `count` groups along random drives, off to the side as a repetition may be."""
    chosen = rng.integers(0, len(drives.poses), count)
    ahead = rng.integers(0, AHEAD_STEPS + 1, (count, GROUP))
    ahead = np.where(rng.random((count, GROUP)) < NOT_AHEAD, 0, ahead)
    poses = np.zeros((count, GROUP, 3))
    for row, drive in enumerate(chosen):
        path = drives.poses[drive]
        poses[row] = path[np.minimum(rng.integers(0, len(path)) + ahead[row], len(path) - 1)]
    group = np.repeat(np.arange(count), GROUP)
    world = drives.world[chosen][group]
    flat = _jitter(drives, world, poses.reshape(-1, 3), rng)
    poses = flat.reshape(count, GROUP, 3)
    moving = np.flatnonzero(np.tile(np.arange(GROUP) < MOVING, count))
    back = _back(len(moving), rng)
    everything = np.concatenate([flat, geometry.compose(flat[moving], back)])
    rows = np.concatenate([np.arange(len(flat)), moving])
    cameras = appearance.sample(rng, count, Robot().camera_height_m).take(group)
    cameras = appearance.vary(rng, cameras).take(rows)
    supersample = 1 if rng.random() < ALIASED else 2
    images = photograph(drives, world[rows], everything, cameras, supersample, rng)
    return Views(
        images[: len(flat)],
        images[len(flat) :],
        geometry.relative(poses[:, NOW], poses[:, TARGET]),
        geometry.relative(everything[len(flat) :], flat[moving]),
    )


def _back(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Poses (N, 3) a short arc behind."""
    length = rng.uniform(0.0, LONGEST_STEP_M, count)
    turned = length * rng.uniform(-CURVATURE_PER_M, CURVATURE_PER_M, count)
    half = turned / 2.0  # so short an arc is its chord
    return np.stack([-length * np.cos(half), length * np.sin(half), -turned], axis=1)


def _jitter(
    drives: Drives,
    world: NDArray[np.int64],
    poses: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Turn poses (N, 3), and move them where there is room."""
    scale = rng.uniform(0.0, MOST_JITTER, (len(poses), 1))
    jitter = scale * rng.normal(0.0, (JITTER_M, JITTER_M, JITTER_RAD), poses.shape)
    moved = poses + jitter
    free = drives.clearance.at(world, moved[:, :2]) > Robot().body_radius_m
    moved[:, :2] = np.where(free[:, None], moved[:, :2], poses[:, :2])
    return moved
