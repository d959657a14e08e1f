"""The stop zone: last in the chain, it knows only the scan and the command about to be sent."""

import numpy as np
from numpy.typing import NDArray

from cbe.arc import along_and_across, free_length, scan_points
from cbe.controller import Motion
from cbe.robot import STEP_S, Robot

MARGIN_M = 0.03  # scan noise and the grid of the ray angles
CONTACT_MARGIN_M = 0.01
REACTION_S = 2.0 * STEP_S  # one step to be executed, one for the scan's age
CREEP_MPS = 0.1  # lets the robot leave a spot that is tight but free


def limit(motion: Motion, scan_m: NDArray[np.floating], robot: Robot) -> Motion:
    """Lower the commanded speed so that the robot can stop before anything on its arc.

    `motion` holds (B,) commands, `scan_m` (B, rays) ranges in metres: inf is no return, NaN is
    invalid. A scan whose rays are all invalid stops the robot; a non-finite command too.
    """
    points = scan_points(scan_m, robot)  # (B, rays, 2)
    steer = np.clip(motion.steer_rad, -robot.max_steer_rad, robot.max_steer_rad)
    curvature = np.nan_to_num(np.tan(steer))[:, None] / robot.wheelbase_m
    along, across = along_and_across(points, curvature)
    free = np.maximum(free_length(along, across, robot.body_radius_m + MARGIN_M), 0.0)
    # Speed v with v * reaction + v^2 / (2 braking) = free.
    lost = robot.max_braking_mps2 * REACTION_S
    allowed = np.sqrt(lost**2 + 2.0 * robot.max_braking_mps2 * free) - lost
    contact = free_length(along, across, robot.body_radius_m + CONTACT_MARGIN_M)
    creeping = contact > CREEP_MPS * REACTION_S + CREEP_MPS**2 / (2.0 * robot.max_braking_mps2)
    allowed = np.where(creeping, np.maximum(allowed, CREEP_MPS), allowed)
    usable = np.isfinite(motion.speed_mps) & np.isfinite(motion.steer_rad)
    usable &= ~np.isnan(scan_m).all(axis=-1)
    speed = np.where(usable, np.minimum(motion.speed_mps, allowed), 0.0)
    return Motion(np.maximum(speed, 0.0), np.nan_to_num(steer))
