"""Any planar lidar's scan brought onto the robot's own rays."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cbe.errors import MessageError
from cbe.messages import LaserScan
from cbe.robot import Robot

MAX_RAYS = 65_536
TURN = 2.0 * math.pi


def scan_message(
    ranges_m: NDArray[np.floating], stamp_ns: int, robot: Robot = Robot(), frame_id: str = "laser"
) -> LaserScan:
    """A message of ranges (rays,) on the robot's own rays."""
    return LaserScan(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        angle_min_rad=robot.scan_angle_min_rad,
        angle_max_rad=-robot.scan_angle_min_rad,
        angle_increment_rad=robot.scan_angle_increment_rad,
        range_min_m=0.0,
        range_max_m=robot.scan_range_m,
        ranges_m=ranges_m.astype(np.float32),
    )


def resample(scan: LaserScan, robot: Robot = Robot()) -> NDArray[np.float32]:
    """Ranges (rays,) float32 in metres along the robot's rays, laser x forward.

    The nearest return of all beams about a ray counts, and that of the beam closest to it where
    beams are sparse. +inf where nothing returned within the robot's range; NaN where the beam
    is invalid or no beam points. -inf, "too close to measure" (REP-117), becomes the lidar's
    least range.

    Raises MessageError for a scan without beams or with angles that make no sense.
    """
    _check(scan)
    ranges = _clean(scan, robot)
    pairs = _pairs(scan.angle_min_rad, scan.angle_increment_rad, len(ranges), robot)
    out = ranges.take(pairs.beam)
    out[pairs.unseen] = np.nan
    np.fmin.at(out, pairs.ray, ranges.take(pairs.other_beam))  # fmin passes over NaN
    return out


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Which beams tell of which rays.

    `beam` (rays,) is the one closest to each ray, meaningless at the `unseen` (k,) ones. The
    others, `other_beam` (n,), tell of the ray closest to each, `ray` (n,).
    """

    beam: NDArray[np.intp]
    unseen: NDArray[np.intp]
    other_beam: NDArray[np.intp]
    ray: NDArray[np.intp]


@lru_cache(maxsize=4)  # a lidar's angles stay the same
def _pairs(angle_min_rad: float, increment_rad: float, beams: int, robot: Robot) -> _Pairs:
    step = robot.scan_angle_increment_rad
    beam_rad = angle_min_rad + increment_rad * np.arange(beams)
    ray_rad = robot.scan_angle_min_rad + step * np.arange(robot.scan_rays)

    # The beam closest to each ray; half a beam's width is let in at either end of the scan.
    turned = np.sign(increment_rad) * (ray_rad - angle_min_rad) + 0.5 * abs(increment_rad)
    beam = np.floor(turned % TURN / abs(increment_rad))
    unseen = np.flatnonzero(beam >= beams)
    beam[unseen] = -1.0  # equals no beam
    closest = beam.astype(np.intp)

    # The ray closest to each beam.
    ahead_rad = (beam_rad + math.pi) % TURN - math.pi
    ray = np.rint((ahead_rad - robot.scan_angle_min_rad) / step).astype(np.intp)
    other = np.flatnonzero((ray >= 0) & (ray < robot.scan_rays))
    other = other[closest[ray[other]] != other]
    return _Pairs(closest, unseen, other, ray[other])


def _check(scan: LaserScan) -> None:
    count = len(scan.ranges_m)
    if not 2 <= count <= MAX_RAYS:
        raise MessageError(f"a scan needs 2 to {MAX_RAYS} beams; found {count}")
    increment, low, high = scan.angle_increment_rad, scan.angle_min_rad, scan.angle_max_rad
    if not all(map(math.isfinite, (increment, low, high))) or increment == 0.0:
        raise MessageError(
            f"a scan's angles make no sense: {low} to {high} rad by {increment} rad a beam"
        )
    span = (count - 1) * increment
    if max(abs(span), abs(low), abs(high)) > 1.05 * TURN:
        raise MessageError(
            f"a scan stays within one turn; found {count} beams from {low:.3f} rad by "
            f"{increment:.5f} rad to {high:.3f} rad; check the lidar driver's angles"
        )
    # Drivers differ by a beam in what they call the last angle.
    if abs(low + span - high) > 2.0 * abs(increment) + 0.01 * abs(span):
        raise MessageError(
            f"a scan's {count} beams from {low:.3f} rad by {increment:.5f} rad end at "
            f"{low + span:.3f} rad, not at its angle_max {high:.3f} rad; check the lidar driver"
        )
    if not 0.0 <= scan.range_min_m < scan.range_max_m:
        raise MessageError(
            f"a scan's ranges make no sense: {scan.range_min_m} to {scan.range_max_m} m"
        )


def _clean(scan: LaserScan, robot: Robot) -> NDArray[np.float32]:
    """Ranges (n,) with NaN where invalid and +inf where nothing is within reach."""
    ranges = scan.ranges_m.astype(np.float32)
    ranges[np.isnan(ranges)] = np.nan  # a signalling NaN warns wherever it is compared
    too_close = np.isneginf(ranges)
    # Many drivers write 0 for "no measurement", whatever their least range.
    invalid = (ranges < scan.range_min_m) | (ranges <= 0.0)
    ranges[invalid] = np.nan
    ranges[too_close] = scan.range_min_m
    ranges[ranges > min(scan.range_max_m, robot.scan_range_m)] = np.inf
    return ranges
