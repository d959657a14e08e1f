"""The robot's fixed dimensions and limits, one dataclass shared by every room."""

import math
from dataclasses import dataclass

STEP_S = 0.1
"""One step: sensors, controller, stop zone and command run at this period."""


@dataclass(frozen=True, slots=True)
class Robot:
    """A small Ackermann car with a camera mast.

    `base_link` is the middle of the rear axle and the axis of the collision cylinder
    (x forward, y left, z up). Lengths in metres, angles in radians.
    """

    wheelbase_m: float = 0.16
    max_steer_rad: float = 0.36
    max_steer_rate_rad_s: float = 3.2
    max_speed_mps: float = 0.5
    max_acceleration_mps2: float = 1.5
    max_braking_mps2: float = 2.0
    body_radius_m: float = 0.12
    body_bottom_m: float = 0.03
    body_top_m: float = 1.05
    camera_x_m: float = 0.065
    camera_height_m: float = 1.0
    scan_x_m: float = 0.08
    scan_height_m: float = 0.15
    scan_fov_rad: float = math.radians(240.0)
    scan_rays: int = 240
    scan_range_m: float = 8.0

    @property
    def scan_angle_min_rad(self) -> float:
        """Angle of the first ray; rays run counter-clockwise."""
        return -0.5 * self.scan_fov_rad

    @property
    def scan_angle_increment_rad(self) -> float:
        """Angle between neighbouring rays, the last ray at `+scan_fov_rad / 2`."""
        return self.scan_fov_rad / (self.scan_rays - 1)

    @property
    def max_curvature_per_m(self) -> float:
        """Tightest turn the steering allows, 1 / radius."""
        return math.tan(self.max_steer_rad) / self.wheelbase_m
