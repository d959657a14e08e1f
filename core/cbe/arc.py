"""Circular arcs driven by base_link and what the scan says about the strip they sweep.

The body is a disc round the rear axle, so along an arc it sweeps a strip of constant width
and whatever lies behind the axle only recedes.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cbe.robot import Robot

FAR_M = 100.0
"""Range put in place of rays without a return: beyond any scanner, still finite."""


def scan_points(scan_m: NDArray[np.floating], robot: Robot) -> NDArray[np.float32]:
    """Returns of scans (B, rays) as base_link points (B, rays, 2)."""
    ranges = finite_ranges(scan_m)
    points = ranges[..., None] * ray_directions(robot, scan_m.shape[-1])
    points[..., 0] += robot.scan_x_m
    return np.asarray(points)


def finite_ranges(scan_m: NDArray[np.floating]) -> NDArray[np.float32]:
    """Ranges (...) in metres; what is not positive, NaN or beyond `FAR_M` becomes `FAR_M`."""
    return np.minimum(np.where(scan_m > 0.0, scan_m, FAR_M), FAR_M).astype(np.float32)


@lru_cache
def ray_directions(robot: Robot, rays: int) -> NDArray[np.float32]:
    """Cosine and sine (rays, 2) of each ray's angle."""
    angle = robot.scan_angle_min_rad + robot.scan_angle_increment_rad * np.arange(rays)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)


def along_and_across(
    points_m: NDArray[np.floating], curvature_per_m: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Arc length (m) to the arc's point nearest to each point, and the distance (m) between.

    `points_m` (..., 2) and `curvature_per_m` broadcast. Arc length is negative behind the axle.
    """
    x, y = points_m[..., 0], points_m[..., 1]
    # Written so that a straight line (curvature 0) needs no case of its own.
    forward, inward = curvature_per_m * x, 1.0 - curvature_per_m * y
    across = (curvature_per_m * (x * x + y * y) - 2.0 * y) / (
        1.0 + np.sqrt(forward * forward + inward * inward)
    )
    straight = np.abs(forward) < 1e-4
    curvature = np.where(straight, 1.0, curvature_per_m)
    along = np.where(straight & (inward > 0.0), x, np.arctan2(forward, inward) / curvature)
    return along, np.abs(across)


def free_length(
    along_m: NDArray[np.floating],
    across_m: NDArray[np.floating],
    radius_m: NDArray[np.floating] | float,
) -> NDArray[np.floating]:
    """Arc length (m) a disc of `radius_m` may go before it touches a point, over the last axis.

    Several radii broadcast against the points. Below 0 where a point ahead is inside the disc
    already; inf where nothing is in the way.
    """
    reach = np.sqrt(np.maximum(radius_m**2 - across_m**2, 0.0))
    hit = (along_m > 0.0) & (across_m < radius_m)
    return np.asarray(np.where(hit, along_m - reach, np.inf).min(axis=-1))
