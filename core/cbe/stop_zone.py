"""The stop zone: last in the chain, it knows only the scan and the command about to be sent."""

import numpy as np
from numpy.typing import NDArray

from cbe.arc import along_and_across, free_length, scan_points
from cbe.controller import Motion
from cbe.robot import STEP_S, Robot

MARGIN_M = 0.03  # scan noise and the grid of the ray angles
CONTACT_MARGIN_M = 0.01
_MARGINS_M = np.array([MARGIN_M, CONTACT_MARGIN_M])[:, None, None]
REACTION_S = 2.0 * STEP_S  # one step to be executed, one for the scan's age
CREEP_MPS = 0.1  # lets the robot leave a spot that is tight but free


def limit(motion: Motion, scan_m: NDArray[np.floating], robot: Robot) -> Motion:
    """Lower the commanded speed so that the robot can stop before anything on its arc.

    `motion` holds (B,) commands, `scan_m` (B, rays) ranges in metres: inf is no return, NaN is
    invalid. A scan whose rays are all invalid stops the robot; a non-finite command too.
    """
    if _out_of_reach(motion, scan_m, robot):
        return motion
    steerable = np.isfinite(motion.steer_rad)
    steer = np.where(steerable, motion.steer_rad, 0.0)
    steer = np.minimum(np.maximum(steer, -robot.max_steer_rad), robot.max_steer_rad)
    points = scan_points(scan_m, robot)  # (B, rays, 2)
    along, across = along_and_across(points, np.tan(steer)[:, None] / robot.wheelbase_m)
    free, contact = free_length(along, across, robot.body_radius_m + _MARGINS_M)
    # Speed v with v * reaction + v^2 / (2 braking) = free.
    lost = robot.max_braking_mps2 * REACTION_S
    reach = np.maximum(free, 0.0)
    allowed = np.sqrt(lost**2 + 2.0 * robot.max_braking_mps2 * reach) - lost
    creeping = contact > CREEP_MPS * REACTION_S + CREEP_MPS**2 / (2.0 * robot.max_braking_mps2)
    allowed = np.maximum(allowed, CREEP_MPS * creeping)
    usable = np.isfinite(motion.speed_mps) & steerable & ~np.isnan(scan_m).all(axis=-1)
    speed = np.minimum(np.where(usable, motion.speed_mps, 0.0), allowed)
    return Motion(np.maximum(speed, 0.0), steer)


def _out_of_reach(motion: Motion, scan_m: NDArray[np.floating], robot: Robot) -> bool:
    """Whether every return is too far away to matter, whatever the arc: true of most steps."""
    speed, steer = motion.speed_mps, np.abs(motion.steer_rad)
    fastest = float(speed.max())
    stopping_m = fastest * REACTION_S + fastest**2 / (2.0 * robot.max_braking_mps2)
    reach_m = robot.scan_x_m + robot.body_radius_m + MARGIN_M + stopping_m
    # What is not finite makes a comparison false.
    possible = float(speed.min()) >= 0.0 and float(steer.max()) <= robot.max_steer_rad
    nearest_m = np.fmin.reduce(scan_m, axis=-1)  # (B,), NaN where a scan says nothing
    return possible and bool((nearest_m > reach_m).all())
