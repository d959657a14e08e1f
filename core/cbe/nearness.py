"""Squared distances of many points from many places in one matrix product.

Both are lifted to 4 numbers whose inner product is |q|^2 - 2 p q + |p|^2 = |q - p|^2.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cbe.arc import finite_ranges, ray_directions
from cbe.robot import Robot

_POOL = 5  # neighbouring rays of which the nearest return counts


def lift_points(
    scan_m: NDArray[np.floating], waypoints_m: Sequence[tuple[float, float]], robot: Robot
) -> NDArray[np.float32]:
    """Returns of scans (B, rays) and then waypoints (B, 2) as the left factor (B, P + 1, 4).

    A point in base_link is lifted to (-2 x, -2 y, x^2 + y^2, 1).
    """
    batch, rays = scan_m.shape
    count = rays // _POOL
    per_metre, at_scanner = _lifted_rays(robot, rays)
    pools = finite_ranges(scan_m)[:, : count * _POOL].reshape(batch, count, _POOL)
    nearest = pools.argmin(axis=2) + np.arange(0, pools.size, _POOL).reshape(batch, count)
    range_m = pools.take(nearest)  # (B, P)
    lifted = np.empty((batch, count + 1, 4), np.float32)
    returns = lifted[:, :-1]
    np.multiply(per_metre.take(nearest, axis=0, mode="wrap"), range_m[..., None], out=returns)
    returns += at_scanner
    returns[..., 2] += range_m * range_m
    lifted[:, -1] = [(-2.0 * x, -2.0 * y, x * x + y * y, 1.0) for x, y in waypoints_m]
    return lifted


def lift_places(x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.float32]:
    """Places x, y (...) in metres as the right factor, (4, ...)."""
    return np.stack([x, y, np.ones_like(x), x * x + y * y]).astype(np.float32)


@lru_cache
def _lifted_rays(robot: Robot, rays: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lifted returns: what each ray in a pool adds per metre (P * pool, 4) and what all have (4,).

    What grows with the square of the range is left out.
    """
    cos, sin = ray_directions(robot, rays)[: rays // _POOL * _POOL].T
    ahead = robot.scan_x_m
    per_metre = np.stack([-2.0 * cos, -2.0 * sin, 2.0 * ahead * cos, 0.0 * cos], axis=1)
    at_scanner = np.array([-2.0 * ahead, 0.0, ahead * ahead, 1.0], np.float32)
    return per_metre.astype(np.float32), at_scanner
