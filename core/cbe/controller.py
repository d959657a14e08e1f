"""Local controller: a waypoint and a scan in, the next speed and steering out (paper, Sec. IV-A).

Riemannian motion policies as in Meng et al. 2019: points round the body are attracted by the
waypoint or repelled by the nearest return, each with its metric, and the accelerations are
pulled back through the bicycle's Jacobians to speed and steering by a pseudo-inverse.

Two things differ from the original, since they drive better. The attracted points follow the
velocities of one arc, so that following is exact and needs no separate heading alignment. And
that arc is not blindly the one to the waypoint but the first of the manoeuvre that costs least
(`cbe.manoeuvres`), which steers round what mere repulsion only brakes for.
"""

from dataclasses import dataclass, field
from math import copysign, cos, exp, hypot, isfinite, sqrt, tan
from typing import cast

import numpy as np
from numpy.typing import NDArray

from cbe.manoeuvres import Choice, ManoeuvreGains, Manoeuvres
from cbe.nearness import lift_places, lift_points
from cbe.robot import STEP_S, Robot

STANDSTILL_MPS = 0.02  # below it a yaw rate says nothing about the steering
_LEAST_STEERING_SPEED_MPS = 0.15  # keeps the steering's Jacobian regular from standstill


@dataclass(frozen=True, slots=True)
class Motion:
    """State or command of B robots: speed (B,) m/s and steering angle (B,) rad, left positive."""

    speed_mps: NDArray[np.float64]
    steer_rad: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RmpGains:
    """Gains of attraction and repulsion, and what bounds the speed."""

    attraction_per_s: float = 8.0  # acceleration per missing velocity
    repulsion_mps2: float = 0.18
    repulsion_damping_per_s: float = 2.0
    # The paper's metric is 1/16. Here the manoeuvres keep clear, and at 1/16 repulsion made the
    # steering half as restless again and lost 3 points of the drives past a bin.
    repulsion_metric: float = 0.003
    repulsion_decay_per_m: float = 9.0
    repulsion_reach_m: float = 0.44
    nose_weight: float = 25.0
    corner_weight: float = 3.0
    manoeuvres: ManoeuvreGains = field(default_factory=ManoeuvreGains)
    waypoint_speed_per_s: float = 3.0  # speed allowed per metre of distance to the waypoint
    arrived_m: float = 0.03
    slipped_m: float = 0.2  # a waypoint behind the axle but this near has been reached
    braking_mps2: float = 1.0  # comfortable, half of what the robot can do
    tight_speed_mps: float = 0.2  # at no clearance, rising to full speed at
    open_clearance_m: float = 0.1
    creep_mps: float = 0.1  # where a manoeuvre is tighter than wished for but touches nothing
    creep_clearance_m: float = 0.015


def twist(motion: Motion, robot: Robot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Speed (B,) m/s and yaw rate (B,) rad/s of a motion."""
    return motion.speed_mps, motion.speed_mps * np.tan(motion.steer_rad) / robot.wheelbase_m


def motion_from_twist(
    speed_mps: NDArray[np.float64],
    yaw_rate_rad_s: NDArray[np.float64],
    previous_steer_rad: NDArray[np.float64],
    robot: Robot,
) -> Motion:
    """Motion that a twist (B,), (B,) asks for; at standstill the steering is held."""
    moving = np.abs(speed_mps) > STANDSTILL_MPS
    curvature = yaw_rate_rad_s / np.where(moving, speed_mps, 1.0)
    steer = np.arctan(curvature * robot.wheelbase_m)
    steer = np.minimum(np.maximum(steer, -robot.max_steer_rad), robot.max_steer_rad)
    return Motion(speed_mps, np.where(moving, steer, previous_steer_rad))


class RmpController:
    """Drives B robots towards their waypoints, stateless but for its tables."""

    def __init__(self, robot: Robot | None = None, gains: RmpGains | None = None) -> None:
        """Lay out the control points and the manoeuvres for `robot`."""
        self.robot = robot = robot or Robot()
        self.gains = gains = gains or RmpGains()
        radius = robot.body_radius_m
        # Nose and front corners are attracted; their metrics, summed at base_link and abreast.
        self._ahead, self._abreast = 3.0, 3.0 * radius * radius
        # Nine points round the front half are repelled: x, y and the metric at no distance.
        angle = np.radians([0.0, 45.0, -45.0, 22.5, -22.5, 67.5, -67.5, 90.0, -90.0])
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        metric = exp(gains.repulsion_decay_per_m * gains.repulsion_reach_m)
        metric *= gains.repulsion_metric
        most = metric * np.array([gains.nose_weight, *[gains.corner_weight] * 2, *[1.0] * 6])
        self._repelled = list(zip(x.tolist(), y.tolist(), most.tolist(), strict=True))
        self._lifted = lift_places(x, y).T.copy()  # (9, 4)
        self._manoeuvres = Manoeuvres(robot, gains.manoeuvres)

    def step(
        self,
        motion: Motion,
        waypoint_m: NDArray[np.floating],
        scan_m: NDArray[np.floating],
    ) -> Motion:
        """Next commanded motion, 0.1 s on and inside the robot's limits, speed >= 0.

        `motion` is the present one, `waypoint_m` (B, 2) in base_link, `scan_m` (B, rays) where
        inf and NaN both mean no return. A non-finite waypoint brakes to a stop.
        """
        robot = self.robot
        speeds, steers = motion.speed_mps.tolist(), motion.steer_rad.tolist()
        present = [tan(steer) / robot.wheelbase_m for steer in steers]
        goals = [_finite(x, y) for x, y in waypoint_m.tolist()]
        distance = [hypot(x, y) for x, y in goals]
        widest = robot.max_curvature_per_m
        toward = [_curvature_to(x, y, widest) for x, y in goals]
        lifted = lift_points(scan_m, goals, robot)
        choices = self._manoeuvres.choose(toward, present, distance, lifted)
        allowed = [
            0.0 if self._reached(x, ahead) else self._allowed_mps(ahead, choice)
            for (x, _), ahead, choice in zip(goals, distance, choices, strict=True)
        ]
        nearest = self._nearest(lifted)
        each = zip(speeds, steers, present, choices, allowed, nearest, strict=True)
        speed, steer = np.array([self._resolve(*one) for one in each]).T
        return Motion(speed, steer)

    def _reached(self, x_m: float, distance_m: float) -> bool:
        """Whether there is nothing left to drive to a waypoint `x_m` ahead, `distance_m` away."""
        gains = self.gains
        return distance_m < gains.arrived_m or (x_m <= 0.0 and distance_m < gains.slipped_m)

    def _allowed_mps(self, distance_m: float, choice: Choice) -> float:
        """Speed that a waypoint's distance and a manoeuvre allow."""
        gains, fastest, tight = self.gains, self.robot.max_speed_mps, self.gains.tight_speed_mps
        faster_per_m = (fastest - tight) / gains.open_clearance_m
        creep = gains.creep_mps if choice.clearance_m > gains.creep_clearance_m else 0.0
        return min(
            gains.waypoint_speed_per_s * distance_m,
            max(sqrt(2.0 * gains.braking_mps2 * choice.free_m), creep),
            tight + faster_per_m * max(choice.clearance_m, 0.0),
            fastest,
        )

    def _nearest(self, lifted: NDArray[np.float32]) -> list[list[tuple[float, float]]]:
        """Place of the return nearest to each repelled point of each of B robots, in m."""
        batch, count = lifted.shape[:2]
        squares = self._lifted @ lifted[:, :-1].swapaxes(1, 2)  # (B, 9, P)
        row = squares.argmin(axis=2) + np.arange(0, batch * count, count)[:, None]  # (B, 9)
        points = -0.5 * lifted[..., :2].reshape(-1, 2).take(row, axis=0)
        return cast(list[list[tuple[float, float]]], points.tolist())

    def _resolve(
        self,
        speed: float,
        steer: float,
        present: float,
        choice: Choice,
        allowed_mps: float,
        nearest: list[tuple[float, float]],
    ) -> tuple[float, float]:
        """Speed m/s and steering angle rad, 0.1 s on, that serve all policies of one robot best.

        A point at (x, y) moves with speed * (1 - c y, c x), so it is accelerated by (1 - c y, c x)
        for each unit of acceleration and by (-y, x) for each of bending, the speed times the
        change of curvature c.
        """
        gains, robot = self.gains, self.robot
        turning = max(speed, _LEAST_STEERING_SPEED_MPS)
        # The attracted points lie symmetric to the axis: summed, they are one at base_link and
        # one abreast, which wish for the velocities they would have on the wanted arc.
        faster = gains.attraction_per_s * (allowed_mps - speed)
        sharper = gains.attraction_per_s * (choice.curvature_per_m - present) * turning
        abreast = present * faster + sharper
        m11 = self._ahead + self._abreast * present * present
        m12 = self._abreast * present
        m22 = self._abreast
        r1 = self._ahead * faster + m12 * abreast
        r2 = self._abreast * abreast
        # The others wish to get away from the return nearest to each.
        wish_at_rest, decay_per_m = gains.repulsion_mps2, gains.repulsion_decay_per_m
        damping_per_s = gains.repulsion_damping_per_s
        for (x, y, most), (near_x, near_y) in zip(self._repelled, nearest, strict=True):
            away_x, away_y = x - near_x, y - near_y
            gap_m = hypot(away_x, away_y) + 1e-9
            across = (away_y * x - away_x * y) / gap_m
            along = away_x / gap_m + present * across
            approach = speed * along
            wish = wish_at_rest if approach > 0.0 else wish_at_rest - damping_per_s * approach
            metric = most * exp(-decay_per_m * gap_m)
            weighted = metric * along
            m11 += weighted * along
            m12 += weighted * across
            r1 += weighted * wish
            weighted = metric * across
            m22 += weighted * across
            r2 += weighted * wish
        # Pseudo-inverse of the 2 x 2 normal equations; the attracted points keep it regular.
        determinant = m11 * m22 - m12 * m12
        acceleration = (m22 * r1 - m12 * r2) / determinant
        bending = (m11 * r2 - m12 * r1) / determinant  # speed times change of curvature
        steer_rate = bending * robot.wheelbase_m * cos(steer) ** 2 / turning

        braking, accelerating = robot.max_braking_mps2, robot.max_acceleration_mps2
        then_mps = speed + _clip(acceleration, -braking, accelerating) * STEP_S
        # What braking can do is never traded against what attraction would like.
        then_mps = min(then_mps, max(allowed_mps, speed - braking * STEP_S))
        quickest, lock = robot.max_steer_rate_rad_s, robot.max_steer_rad
        then_rad = steer + _clip(steer_rate, -quickest, quickest) * STEP_S
        return _clip(then_mps, 0.0, robot.max_speed_mps), _clip(then_rad, -lock, lock)


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _finite(x: float, y: float) -> tuple[float, float]:
    """The place itself, or where the robot is if it is not finite."""
    return (x, y) if isfinite(x) and isfinite(y) else (0.0, 0.0)


def _curvature_to(x: float, y: float, widest: float) -> float:
    """Curvature of the arc from base_link through a place, clipped to full lock."""
    if x < 0.0:  # what lies behind needs a full turn to its side
        return copysign(widest, y)
    return _clip(2.0 * y / max(x * x + y * y, 0.0025), -widest, widest)
