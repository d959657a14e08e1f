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

import numpy as np
from numpy.typing import NDArray

from cbe.arc import scan_points
from cbe.manoeuvres import ManoeuvreGains, Manoeuvres
from cbe.nearness import lift_places, lift_points
from cbe.robot import STEP_S, Robot

STANDSTILL_MPS = 0.02  # below it a yaw rate says nothing about the steering
_POOL = 5  # rays to one point in the controller
_ATTRACTED = 3  # of the control points
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
    steer = _within(steer, -robot.max_steer_rad, robot.max_steer_rad)
    return Motion(speed_mps, np.where(moving, steer, previous_steer_rad))


class RmpController:
    """Drives B robots towards their waypoints, stateless but for its tables."""

    def __init__(self, robot: Robot | None = None, gains: RmpGains | None = None) -> None:
        """Lay out the control points and the manoeuvres for `robot`."""
        self.robot = robot = robot or Robot()
        self.gains = gains = gains or RmpGains()
        radius = robot.body_radius_m
        # Nose and front corners are attracted; nine points round the front half are repelled.
        repelled = [0.0, 45.0, -45.0, 22.5, -22.5, 67.5, -67.5, 90.0, -90.0]
        angle = np.radians([0.0, 45.0, -45.0, *repelled])
        self._points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (12, 2)
        self._repelled = lift_places(*self._points[_ATTRACTED:].T)  # (4, 9)
        weight = np.ones(len(repelled))
        weight[0] = gains.nose_weight
        weight[1:3] = gains.corner_weight
        reach = np.exp(gains.repulsion_decay_per_m * gains.repulsion_reach_m)
        spread_m2 = (self._points[:_ATTRACTED] ** 2).sum()
        attracted = (float(_ATTRACTED), float(spread_m2))
        # Of attraction, and of repulsion at no distance.
        self._metric = np.append(attracted, weight * gains.repulsion_metric * reach)  # (11,)
        self._manoeuvres = Manoeuvres(robot, gains.manoeuvres)
        # Of speed and steering, and of their rates, (2, 1).
        self._least = np.array([[0.0], [-robot.max_steer_rad]])
        self._most = np.array([[robot.max_speed_mps], [robot.max_steer_rad]])
        self._least_rates = -np.array([[robot.max_braking_mps2], [robot.max_steer_rate_rad_s]])
        self._most_rates = np.array([[robot.max_acceleration_mps2], [robot.max_steer_rate_rad_s]])

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
        known = np.isfinite(waypoint_m[:, 0]) & np.isfinite(waypoint_m[:, 1])
        waypoint = np.where(known[:, None], waypoint_m, 0.0).astype(np.float64)
        points = scan_points(scan_m, robot, _POOL)
        lifted = lift_points(waypoint, points)
        present = np.tan(motion.steer_rad) / robot.wheelbase_m
        curvature, wanted_speed = self._choose_arc(present, waypoint, lifted)
        wanted_speed *= known
        rates = self._resolve(motion, present, curvature, wanted_speed, points, lifted)
        rates = _within(rates, self._least_rates, self._most_rates)
        then = np.array([motion.speed_mps, motion.steer_rad]) + rates * STEP_S
        # What braking can do is never traded against what attraction would like.
        floor = motion.speed_mps - robot.max_braking_mps2 * STEP_S
        np.minimum(then[0], np.maximum(wanted_speed, floor), out=then[0])
        speed, steer = _within(then, self._least, self._most)
        return Motion(speed, steer)

    def _choose_arc(
        self,
        present: NDArray[np.float64],
        waypoint: NDArray[np.float64],
        lifted: NDArray[np.float32],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Curvature (B,) to steer and the speed (B,) it allows; `present` (B,) is being steered."""
        gains, robot = self.gains, self.robot
        distance = np.hypot(waypoint[:, 0], waypoint[:, 1])
        toward = _curvature_to(waypoint, distance, robot.max_curvature_per_m)
        choice = self._manoeuvres.choose(toward, present, distance, lifted)
        slipped = (waypoint[:, 0] <= 0.0) & (distance < gains.slipped_m)
        reached = slipped | (distance < gains.arrived_m)
        speed = gains.waypoint_speed_per_s * distance * ~reached
        speed = np.minimum(speed, np.sqrt(2.0 * gains.braking_mps2 * choice.free_m))
        tight = gains.tight_speed_mps
        faster_per_m = (robot.max_speed_mps - tight) / gains.open_clearance_m
        clearance = np.maximum(choice.clearance_m, 0.0)
        speed = np.minimum(speed, tight + faster_per_m * clearance)
        return choice.curvature_per_m, np.minimum(speed, robot.max_speed_mps)

    def _resolve(
        self,
        motion: Motion,
        present: NDArray[np.float64],
        curvature: NDArray[np.float64],
        wanted_speed: NDArray[np.float64],
        points: NDArray[np.float32],
        lifted: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        """Acceleration m/s2 and steering rate rad/s (2, B) that serve all policies best."""
        gains, wheelbase = self.gains, self.robot.wheelbase_m
        speed, steer = motion.speed_mps, motion.steer_rad
        turning = np.maximum(speed, _LEAST_STEERING_SPEED_MPS)
        gain = turning / (wheelbase * np.cos(steer) ** 2)
        # A point at (x, y) moves with speed * (1 - c y, c x); its Jacobian's columns are
        # (1 - c y, c x) for speed and gain * (-y, x) for steering. A row for each policy: what
        # these are along its direction, and the acceleration it wishes there.
        rows = np.empty((len(points), 3, len(self._metric)))
        metric = np.empty((len(points), len(self._metric)))
        metric[:] = self._metric

        repelled = self._points[_ATTRACTED:]  # (9, 2)
        nearest = (lifted[:, 1:] @ self._repelled).argmin(axis=1)  # (B, 9)
        away = repelled - points[np.arange(len(points))[:, None], nearest]  # (B, 9, 2)
        gap_m = np.maximum(np.hypot(away[..., 0], away[..., 1]), 1e-3)
        away = away / gap_m[..., None]
        x, y = repelled[:, 0], repelled[:, 1]
        across = away[..., 1] * x - away[..., 0] * y  # (B, 9)
        by_speed, by_steer = away[..., 0] + present[:, None] * across, gain[:, None] * across
        approach = np.minimum(speed[:, None] * by_speed, 0.0)
        rows[:, 0, 2:], rows[:, 1, 2:] = by_speed, by_steer
        rows[:, 2, 2:] = gains.repulsion_mps2 - gains.repulsion_damping_per_s * approach
        metric[:, 2:] *= np.exp(-gains.repulsion_decay_per_m * gap_m)

        # The attracted points lie symmetric to the axis: summed, they are one at base_link and
        # one abreast, which wish for the velocities they would have on the wanted arc.
        faster = gains.attraction_per_s * (wanted_speed - speed)
        sharper = gains.attraction_per_s * (curvature - present) * turning
        rows[:, 0, 0], rows[:, 1, 0], rows[:, 2, 0] = 1.0, 0.0, faster
        rows[:, 0, 1], rows[:, 1, 1], rows[:, 2, 1] = present, gain, present * faster + sharper

        # Pseudo-inverse of the 2 x 2 normal equations; the attracted points keep it regular.
        sums = (rows * metric[:, None]) @ rows.swapaxes(1, 2)  # (B, 3, 3)
        m11, m12, m22 = sums[:, 0, 0], sums[:, 0, 1], sums[:, 1, 1]
        r1, r2 = sums[:, 0, 2], sums[:, 1, 2]
        determinant = m11 * m22 - m12 * m12
        return np.array([m22 * r1 - m12 * r2, m11 * r2 - m12 * r1]) / determinant


def _within(
    value: NDArray[np.float64],
    low: NDArray[np.float64] | float,
    high: NDArray[np.float64] | float,
) -> NDArray[np.float64]:
    """Clip; np.clip costs five times as much on a single robot's arrays."""
    return np.asarray(np.minimum(np.maximum(value, low), high))


def _curvature_to(
    waypoint: NDArray[np.float64], distance: NDArray[np.float64], widest: float
) -> NDArray[np.float64]:
    """Curvature (B,) of the arc from base_link through each waypoint, clipped to full lock."""
    x, y = waypoint[:, 0], waypoint[:, 1]
    curvature = 2.0 * y / np.maximum(distance, 0.05) ** 2
    # What lies behind needs a full turn to its side.
    curvature = np.where(x < 0.0, np.copysign(widest, y), curvature)
    return _within(curvature, -widest, widest)
