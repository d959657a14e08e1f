"""Squared distances of many points from many places in one matrix product.

Both are lifted to 4 numbers whose inner product is |q|^2 - 2 p q + |p|^2 = |q - p|^2.
"""

import numpy as np
from numpy.typing import NDArray


def lift_points(
    waypoint_m: NDArray[np.float64], points_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Waypoints (B, 2) and then scan points (B, P, 2) as the left factor, (B, 1 + P, 4)."""
    batch, count = points_m.shape[:2]
    lifted = np.empty((batch, 1 + count, 4), np.float32)
    lifted[:, 0, :2], lifted[:, 1:, :2] = waypoint_m, points_m
    x, y = lifted[..., 0], lifted[..., 1]
    lifted[..., 2] = x * x + y * y
    lifted[..., :2] *= np.float32(-2.0)
    lifted[..., 3] = 1.0
    return lifted


def lift_places(x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.float32]:
    """Places x, y (...) in metres as the right factor, (4, ...)."""
    return np.stack([x, y, np.ones_like(x), x * x + y * y]).astype(np.float32)
