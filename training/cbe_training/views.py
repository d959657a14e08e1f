"""Independent views for learning to see: groups of nearby ones, and pairs of frames.

Rollouts teach the convolutions little per frame, for their frames all look alike. Here every
image is of another place, and M views of one make M (M - 1) examples.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cbe import geometry
from cbe.robot import Robot
from cbe_training import appearance
from cbe_training.drives import Drives
from cbe_training.rollout import ALIASED, OTHER_GAPS, USUAL_GAP, photograph

GROUP = 6
AHEAD_STEPS = 40  # views lie up to 2 m further along the drive
NOT_AHEAD = 0.4  # share of views at the group's first pose
JITTER_M, JITTER_RAD = 0.3, 0.4
MOST_JITTER = 1.6
LONGEST_STEP_M = 0.15  # three steps at full speed
GAPS = sorted((*OTHER_GAPS, *[USUAL_GAP] * 4))  # between two frames, as often as in rollouts
AT_FULL_SPEED = 0.7  # share of the pairs
CURVATURE_PER_M = 2.3  # the vehicle's tightest
NOW, TARGET = np.nonzero(~np.eye(GROUP, dtype=np.bool_))  # all ordered pairs of a group


@dataclass(frozen=True, slots=True)
class Views:
    """G groups of views; `relation` holds the pose of view TARGET in the frame of view NOW."""

    images: NDArray[np.uint8]  # (G * GROUP, 64, 64, 3)
    relation: NDArray[np.float64]  # (G, len(NOW), 3)


@dataclass(frozen=True, slots=True)
class Steps:
    """N pairs of frames; `motion` (N, 3) is the pose of `now` in the frame of `before`."""

    before: NDArray[np.uint8]  # (N, 64, 64, 3)
    now: NDArray[np.uint8]  # (N, 64, 64, 3)
    motion: NDArray[np.float64]


def draw(drives: Drives, count: int, rng: np.random.Generator) -> Views:
    """Draw `count` groups along random drives, off to the side as a repetition may be."""
    ahead = rng.integers(0, AHEAD_STEPS + 1, (count, GROUP))
    ahead = np.where(rng.random((count, GROUP)) < NOT_AHEAD, 0, ahead)
    world, flat = _stand(drives, ahead, rng)
    cameras = appearance.sample(rng, count, Robot().camera_height_m)
    cameras = appearance.vary(rng, cameras.take(np.repeat(np.arange(count), GROUP)))
    images = photograph(drives, world, flat, cameras, _supersample(rng), rng)
    poses = flat.reshape(count, GROUP, 3)
    return Views(images, geometry.relative(poses[:, NOW], poses[:, TARGET]))


def draw_steps(drives: Drives, count: int, rng: np.random.Generator) -> Steps:
    """Draw `count` short arcs along random drives, as long as a robot's are.

    A turn tells more of how far it led than the picture does, where only long steps turn so far.
    """
    world, now = _stand(drives, np.zeros((count, 1), np.int64), rng)
    speed = np.where(rng.random(count) < AT_FULL_SPEED, 1.0, rng.random(count))
    length = speed * rng.choice(GAPS, count) * LONGEST_STEP_M / max(GAPS)
    turned = length * rng.uniform(-CURVATURE_PER_M, CURVATURE_PER_M, count)
    half = turned / 2.0  # so short an arc is its chord
    back = np.stack([-length * np.cos(half), length * np.sin(half), -turned], axis=1)
    before = geometry.compose(now, back)
    cameras = appearance.sample(rng, count, Robot().camera_height_m)
    cameras, supersample = appearance.vary(rng, cameras), _supersample(rng)
    first, second = (
        photograph(drives, world, poses, cameras, supersample, rng) for poses in (before, now)
    )
    return Steps(first, second, geometry.relative(before, now))


def _supersample(rng: np.random.Generator) -> int:
    return 1 if rng.random() < ALIASED else 2


def _stand(
    drives: Drives, ahead: NDArray[np.int64], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Worlds (G * M,) and poses (G * M, 3), `ahead` (G, M) steps on from G places on drives."""
    count, each = ahead.shape
    chosen = rng.integers(0, len(drives.poses), size=(count,))
    poses = np.zeros((count, each, 3))
    for row, drive in enumerate(chosen):
        path = drives.poses[drive]
        poses[row] = path[np.minimum(rng.integers(0, len(path)) + ahead[row], len(path) - 1)]
    world = np.repeat(drives.world[chosen], each)
    return world, _jitter(drives, world, poses.reshape(-1, 3), rng)


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
