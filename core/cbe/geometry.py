"""Planar poses: arrays (..., 3) of x (m), y (m), yaw (rad, counter-clockwise)."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


def wrap_angle(angle_rad: Floats) -> NDArray[np.float64]:
    """Wrap to [-pi, pi)."""
    return np.asarray((angle_rad + np.pi) % (2.0 * np.pi) - np.pi, np.float64)


def compose(a_from_b: Floats, b_from_c: Floats) -> NDArray[np.float64]:
    """Chain poses (..., 3): the pose of c in a. Leading shapes broadcast."""
    cos, sin = np.cos(a_from_b[..., 2]), np.sin(a_from_b[..., 2])
    x = a_from_b[..., 0] + cos * b_from_c[..., 0] - sin * b_from_c[..., 1]
    y = a_from_b[..., 1] + sin * b_from_c[..., 0] + cos * b_from_c[..., 1]
    return np.stack([x, y, wrap_angle(a_from_b[..., 2] + b_from_c[..., 2])], axis=-1)


def relative(world_from_a: Floats, world_from_b: Floats) -> NDArray[np.float64]:
    """Pose of b seen from a (..., 3), the inverse of `compose` on its second argument."""
    dx = world_from_b[..., 0] - world_from_a[..., 0]
    dy = world_from_b[..., 1] - world_from_a[..., 1]
    cos, sin = np.cos(world_from_a[..., 2]), np.sin(world_from_a[..., 2])
    yaw = wrap_angle(world_from_b[..., 2] - world_from_a[..., 2])
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, yaw], axis=-1)


def to_frame(world_from_a: Floats, points: Floats) -> NDArray[np.float64]:
    """World points (..., 2) in frame a; `world_from_a` is (..., 3), leading shapes broadcast."""
    dx = points[..., 0] - world_from_a[..., 0]
    dy = points[..., 1] - world_from_a[..., 1]
    cos, sin = np.cos(world_from_a[..., 2]), np.sin(world_from_a[..., 2])
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)


def from_frame(world_from_a: Floats, points: Floats) -> NDArray[np.float64]:
    """Points (..., 2) of frame a in the world, the inverse of `to_frame`."""
    cos, sin = np.cos(world_from_a[..., 2]), np.sin(world_from_a[..., 2])
    x = world_from_a[..., 0] + cos * points[..., 0] - sin * points[..., 1]
    y = world_from_a[..., 1] + sin * points[..., 0] + cos * points[..., 1]
    return np.stack([x, y], axis=-1)
