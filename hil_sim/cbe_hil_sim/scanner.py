"""Planar lidar scans of 2.5-D worlds."""

import numpy as np
from numpy.typing import NDArray

from cbe.robot import Robot
from cbe_hil_sim.march import scan_rays
from cbe_hil_sim.worldbatch import WorldBatch


def scan(
    batch: WorldBatch,
    world_index: NDArray[np.integer],
    pose: NDArray[np.floating],
    robot: Robot,
) -> NDArray[np.float32]:
    """Distances (B, rays) in metres that B robots at `pose` (B, 3) measure, +inf beyond range.

    A ray ends at the first cell whose solid reaches the scan's height or whose span covers
    it, or where the grid ends; a sensor inside such a cell reads 0. Rays run
    counter-clockwise from `robot.scan_angle_min_rad`. Raises WorldError for bad indices or
    poses.
    """
    world_index = np.asarray(world_index, np.int64)
    sensor = np.array(pose, np.float64)
    batch.check(world_index, sensor)
    sensor[:, 0] += robot.scan_x_m * np.cos(sensor[:, 2])
    sensor[:, 1] += robot.scan_x_m * np.sin(sensor[:, 2])
    rays = np.arange(robot.scan_rays)
    angles_rad = robot.scan_angle_min_rad + rays * robot.scan_angle_increment_rad
    scans_m = np.empty((len(world_index), robot.scan_rays), np.float32)
    scan_rays(
        batch, world_index, sensor, angles_rad, robot.scan_height_m, robot.scan_range_m, scans_m
    )
    return scans_m
