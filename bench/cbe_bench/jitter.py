"""Starts beside a demonstration's own, drawn and kept as the paper's evaluation does.

The offsets, the swollen body and the overlap of both views are those of its public code; it drives
on from the demonstration's own start where five draws fail, here another drive is taken.
"""

import math

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA
from cbe.geometry import wrap_angle
from cbe.robot import Robot
from cbe_hil_sim.march import scan_rays
from cbe_hil_sim.world import World
from cbe_hil_sim.worldbatch import WorldBatch

JITTER_M, JITTER_LIMIT_M = 0.3, 1.0
JITTER_RAD = math.radians(13.5)
MIN_OVERLAP = 0.6
"""Least share of each of the two views, the start's and the demonstration's, in the other."""
CLEARANCE_M = 0.08  # from the body's surface
ROOM_M = np.array([(0.54, 0.0), (0.39, 0.24), (0.195, 0.24), (0.0, 0.24), (-0.195, 0.24),
                   (-0.39, 0.24), (-0.39, 0.0)])  # fmt: skip
"""Left half of the authors' control points round the car's body, three times as far out."""
_TRIES = 100
_COLUMNS = 100  # of a view
_SURFACE_M = 0.06  # how far before a surface its points are sought, so that none lies inside
_FAR_M = 50.0


def jittered(
    world: World,
    batch: WorldBatch,
    pose: NDArray[np.floating],
    scale: float,
    rng: np.random.Generator,
) -> NDArray[np.float64] | None:
    """A start (3,) near `pose` (3,), with room around it and a like view, or None.

    `batch` holds the one world that the views are of; what stands in `world` beyond it only
    takes room. At scale 0 the start is the pose itself.
    """
    own: NDArray[np.float64] = np.asarray(pose, np.float64)
    for _ in range(_TRIES if scale > 0.0 else 0):
        offset = rng.normal(0.0, 1.0, 2) * JITTER_M * scale
        offset *= min(1.0, JITTER_LIMIT_M / max(float(np.hypot(*offset)), 1e-9))
        start: NDArray[np.float64] = own + np.array([*offset, rng.normal() * JITTER_RAD * scale])
        if is_kept(world, batch, start, own):
            return start
    return None if scale > 0.0 else own


def is_kept(
    world: World, batch: WorldBatch, start: NDArray[np.float64], pose: NDArray[np.float64]
) -> bool:
    """Whether a start (3,) beside a demonstrated pose (3,) has room and a like view."""
    return _has_room(world, start) and min(view_overlap(batch, start, pose)) >= MIN_OVERLAP


def _has_room(world: World, start: NDArray[np.float64]) -> bool:
    """Whether the body and the lines to the swollen body's control points are free."""
    if world.clearance_at(start[:2]) <= Robot().body_radius_m + CLEARANCE_M:
        return False
    reach = np.concatenate([ROOM_M, ROOM_M[1:-1] * (1.0, -1.0)])
    cos, sin = math.cos(start[2]), math.sin(start[2])
    tips = reach @ np.array([[cos, sin], [-sin, cos]])
    lines = start[:2] + np.linspace(0.0, 1.0, 17)[:, None, None] * tips
    return bool(world.clearance_at(lines).min() > 0.0)


def view_overlap(
    batch: WorldBatch, one: NDArray[np.floating], other: NDArray[np.floating]
) -> tuple[float, float]:
    """Share of the view at one pose (3,) of a world that is seen at the other, and the reverse.

    In the plane of the lidar, over the columns of the model's camera.
    """
    return _seen(batch, one, other), _seen(batch, other, one)


def _seen(batch: WorldBatch, one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    camera = MODEL_CAMERA
    column = np.linspace(0.0, camera.width, _COLUMNS)
    angles_rad = np.arctan((camera.cx - column) / camera.fx)
    from_one, from_other = (_lens(pose) for pose in (one, other))
    ranges_m = np.minimum(_cast(batch, from_one[None], angles_rad)[0], _FAR_M) - _SURFACE_M
    heading = from_one[2] + angles_rad
    points = from_one[:2] + ranges_m[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    apart = points - from_other[:2]
    bearing = np.arctan2(apart[:, 1], apart[:, 0])
    eyes = np.column_stack([np.broadcast_to(from_other[:2], apart.shape), bearing])
    free_m = _cast(batch, eyes, np.zeros(1))[:, 0]
    inside = np.abs(wrap_angle(bearing - from_other[2])) <= angles_rad[0] + 1e-6
    return float(np.mean(inside & (np.hypot(*apart.T) < free_m)))


def _lens(pose: NDArray[np.floating]) -> NDArray[np.float64]:
    """Pose (3,) of the camera of a robot at `pose` (3,)."""
    ahead = Robot().camera_x_m * np.array([math.cos(pose[2]), math.sin(pose[2]), 0.0])
    return np.asarray(pose + ahead, np.float64)


def _cast(
    batch: WorldBatch, eyes: NDArray[np.float64], angles_rad: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Distances (B, rays) in the batch's first world, from poses (B, 3)."""
    ranges_m = np.empty((len(eyes), len(angles_rad)), np.float32)
    first = np.zeros(len(eyes), np.int64)
    scan_rays(batch, first, eyes, angles_rad, Robot().scan_height_m, _FAR_M, ranges_m)
    return ranges_m
