"""Short manoeuvres, two arcs each, scored against the scan: which way round an obstacle to go.

Repulsion alone, and a single arc too, drive into dead ends beside an obstacle; a second arc
shows early enough whether the car, which cannot reverse, will get out again behind it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cbe.robot import Robot

Floats = NDArray[np.floating]

SPACING_M = 0.12  # between the checked places of a manoeuvre
FIRST_SAMPLES, SECOND_SAMPLES = 3, 7
SAMPLES = FIRST_SAMPLES + SECOND_SAMPLES
_OPEN_M = 10.0  # clearance and free length where nothing is near


@dataclass(frozen=True, slots=True)
class ManoeuvreGains:
    """What a manoeuvre may cost; curvatures count in parts of full lock."""

    first_arcs: int = 11
    second_arcs: int = 7
    near_waypoint_m: float = 0.35  # from here on, way beyond the waypoint counts
    beyond_per_m: float = 3.0  # so much, per metre
    wanted_clearance_m: float = 0.2  # between body and obstacle
    least_clearance_m: float = 0.03
    miss_weight_per_m: float = 1.0  # nearest distance to the waypoint
    clearance_weight: float = 2.0
    blocked_weight: float = 4.0
    toward_weight: float = 0.3  # first arc's change from the waypoint's curvature
    change_weight: float = 0.15  # first arc's change from the present curvature


@dataclass(frozen=True, slots=True)
class Choice:
    """Chosen manoeuvres of B robots: first curvature, least clearance, free length (B,)."""

    curvature_per_m: NDArray[np.float64]
    clearance_m: Floats
    free_m: Floats


class Manoeuvres:
    """A fixed tree of manoeuvres in base_link; besides it the one arc to the waypoint."""

    def __init__(self, robot: Robot, gains: ManoeuvreGains) -> None:
        """Lay out the tree within the robot's steering limit."""
        self._robot, self._gains = robot, gains
        widest = robot.max_curvature_per_m
        first = np.linspace(-widest, widest, gains.first_arcs)
        second = np.linspace(-widest, widest, gains.second_arcs)
        self._first = np.repeat(first, gains.second_arcs)  # (T,)
        lead_x, lead_y = _arc(first, FIRST_SAMPLES)  # (F, 3)
        tail_x, tail_y = _arc(second, SECOND_SAMPLES)  # (G, 7)
        turned = (first * SPACING_M * FIRST_SAMPLES)[:, None, None]
        x = lead_x[:, -1, None, None] + np.cos(turned) * tail_x - np.sin(turned) * tail_y
        y = lead_y[:, -1, None, None] + np.sin(turned) * tail_x + np.cos(turned) * tail_y
        # (4, F * 3 + F * G * 7): the leads, each shared by G manoeuvres, then the tails.
        x, y = np.append(lead_x, x), np.append(lead_y, y)
        self._tree = np.stack([x, y, np.ones_like(x), x * x + y * y]).astype(np.float32)
        manoeuvre = np.arange(len(self._first))
        begin = manoeuvre[:, None] // gains.second_arcs * FIRST_SAMPLES + np.arange(FIRST_SAMPLES)
        end = lead_x.size + manoeuvre[:, None] * SECOND_SAMPLES + np.arange(SECOND_SAMPLES)
        direct = self._tree.shape[1] + np.arange(SAMPLES)  # the arc to the waypoint comes last
        rows = np.concatenate([np.concatenate([begin, end], axis=1), direct[None]])
        self._samples = np.ascontiguousarray(rows.T)  # (10, T + 1) places of each manoeuvre
        self._toward_weight_m = gains.toward_weight / widest
        self._change_weight_m = gains.change_weight / widest
        self._travelled = (SPACING_M * np.arange(1, SAMPLES + 1)).astype(np.float32)

    def choose(
        self,
        toward_per_m: NDArray[np.float64],
        present_per_m: NDArray[np.float64],
        waypoint_m: NDArray[np.float64],
        points_m: NDArray[np.float32],
    ) -> Choice:
        """Cheapest manoeuvre of each of B robots.

        `toward_per_m` (B,) leads to `waypoint_m` (B, 2), `present_per_m` (B,) is being steered,
        `points_m` (B, P, 2) is the scan, all in base_link.
        """
        gains = self._gains
        batch, tree = len(toward_per_m), self._tree.shape[1]
        places = np.empty((batch, 4, tree + SAMPLES), np.float32)
        places[:, :, :tree] = self._tree
        x, y = _arc(toward_per_m, SAMPLES)
        places[:, 0, tree:], places[:, 1, tree:], places[:, 2, tree:] = x, y, 1.0
        places[:, 3, tree:] = x * x + y * y
        square = _square_m2(places, points_m, waypoint_m)
        nearest = np.maximum(square[:, :-1].min(axis=1), 0.0)
        sample = np.sqrt(nearest).take(self._samples, axis=1)
        sample -= np.float32(self._robot.body_radius_m)  # (B, 10, T + 1)
        miss = square[:, -1].take(self._samples, axis=1).min(axis=1)  # (B, T + 1)
        miss = np.sqrt(np.maximum(miss, 0.0))

        distance = np.hypot(waypoint_m[:, 0], waypoint_m[:, 1]).astype(np.float32)
        # A waypoint nearer than usual is the goal: nothing behind it matters.
        beyond = gains.beyond_per_m * np.maximum(distance - gains.near_waypoint_m, 0.0)
        horizon = np.minimum(distance + beyond, self._travelled[-1])[:, None]
        unminded = self._travelled > horizon + np.float32(0.5 * SPACING_M)  # (B, 10)
        sample += (unminded * np.float32(_OPEN_M))[..., None]
        clearance = sample.min(axis=1)  # (B, T + 1)
        hit = clearance < gains.least_clearance_m
        free = SPACING_M * (sample < gains.least_clearance_m).argmax(axis=1)  # where it hits

        first = np.empty((batch, len(self._first) + 1))  # (B, T + 1)
        first[:, :-1], first[:, -1] = self._first, toward_per_m
        short = 1.0 - clearance / gains.wanted_clearance_m
        short = np.minimum(np.maximum(short, 0.0), 1.5)
        blocked = hit * np.maximum(1.0 - free / np.maximum(horizon, SPACING_M), 0.0)
        cost = self._toward_weight_m * np.abs(first - toward_per_m[:, None])
        cost += self._change_weight_m * np.abs(first - present_per_m[:, None])
        cost += gains.miss_weight_per_m * miss
        cost += gains.clearance_weight * short * short + gains.blocked_weight * blocked
        best = cost.argmin(axis=1) + np.arange(batch) * cost.shape[1]
        free_m = np.where(hit.take(best), free.take(best), _OPEN_M)
        return Choice(first.take(best), clearance.take(best), free_m)


def _arc(
    curvature_per_m: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places x, y (N, count) each `SPACING_M` along arcs (N,) that leave the origin forward."""
    curvature = (curvature_per_m + (np.abs(curvature_per_m) < 1e-6) * 2e-6)[:, None]
    angle = curvature * (SPACING_M * np.arange(1, count + 1))
    return np.sin(angle) / curvature, (1.0 - np.cos(angle)) / curvature


def _square_m2(
    places: NDArray[np.float32], points: NDArray[np.float32], waypoint: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Squared distances (B, P + 1, N) of points (B, P, 2), then waypoints (B, 2), from places.

    `places` (B, 4, N) are x, y, 1, x^2 + y^2.
    """
    # |q - p|^2 = |q|^2 + |p|^2 - 2 p q: one product, and hardly a pass over its N columns besides.
    batch, count = points.shape[:2]
    ends = np.empty((batch, count + 1, 4), np.float32)
    ends[:, :count, :2], ends[:, count, :2] = points, waypoint
    x, y = ends[..., 0], ends[..., 1]
    ends[..., 2] = x * x + y * y
    ends[..., :2] *= np.float32(-2.0)
    ends[..., 3] = 1.0
    return np.asarray(ends @ places)
