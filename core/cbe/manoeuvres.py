"""Short manoeuvres, two arcs each, scored against the scan: which way round an obstacle to go.

Repulsion alone, and a single arc too, drive into dead ends beside an obstacle; a second arc
shows early enough whether the car, which cannot reverse, will get out again behind it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cbe.nearness import lift_places
from cbe.robot import Robot

Floats = NDArray[np.floating]

SPACING_M = 0.12  # between the checked places of a manoeuvre
FIRST_SAMPLES, SECOND_SAMPLES = 3, 7
SAMPLES = FIRST_SAMPLES + SECOND_SAMPLES
_OPEN_M = 10.0  # clearance and free length where nothing is near
_MOST_LACK = 1.5  # in parts of the wanted clearance
_REAR_POINTS = 4  # on each side, of 48: 100 deg and more from ahead, forward drives only leave them
_DIRECT_ARCS = 257  # to the waypoint; the nearest one is less than 7 mm off at its end


@dataclass(frozen=True, slots=True)
class ManoeuvreGains:
    """What a manoeuvre may cost; curvatures count in parts of full lock."""

    first_arcs: int = 11
    second_arcs: int = 5
    near_waypoint_m: float = 0.35  # from here on, way beyond the waypoint counts
    beyond_per_m: float = 3.0  # so much, per metre
    wanted_clearance_m: float = 0.2  # between body and obstacle
    least_clearance_m: float = 0.03
    miss_weight_per_m: float = 1.0  # nearest distance to the waypoint
    away_weight_per_m: float = 1.5  # how much farther it ends than straight past the waypoint
    clearance_weight: float = 2.0
    blocked_weight: float = 4.0
    toward_weight: float = 0.3  # first arc's change from the waypoint's curvature
    change_weight: float = 0.15  # first arc's change from the present curvature


class Choice(NamedTuple):
    """The manoeuvre chosen for one robot: its first curvature, least clearance, free length."""

    curvature_per_m: float
    clearance_m: float
    free_m: float


class Manoeuvres:
    """A fixed tree of manoeuvres in base_link; besides it the one arc to the waypoint."""

    def __init__(self, robot: Robot, gains: ManoeuvreGains) -> None:
        """Lay out the tree within the robot's steering limit."""
        self._robot, self._gains = robot, gains
        widest = robot.max_curvature_per_m
        first = np.linspace(-widest, widest, gains.first_arcs)
        second = np.linspace(-widest, widest, gains.second_arcs)
        # (T + 1,): the arc to the waypoint comes last and has its own curvature.
        self._first = np.append(np.repeat(first, gains.second_arcs), 0.0).astype(np.float32)
        lead_x, lead_y = _arc(first, FIRST_SAMPLES)  # (F, 3)
        tail_x, tail_y = _arc(second, SECOND_SAMPLES)  # (G, 7)
        turned = (first * SPACING_M * FIRST_SAMPLES)[:, None, None]
        x = lead_x[:, -1, None, None] + np.cos(turned) * tail_x - np.sin(turned) * tail_y
        y = lead_y[:, -1, None, None] + np.sin(turned) * tail_x + np.cos(turned) * tail_y
        # (4, F * 3 + F * G * 7): the leads, each shared by G manoeuvres, then the tails.
        self._tree = lift_places(np.append(lead_x, x), np.append(lead_y, y))
        arcs = np.linspace(-widest, widest, _DIRECT_ARCS)
        self._direct = lift_places(*_arc(arcs, SAMPLES)).swapaxes(0, 1).copy()  # (A, 4, 10)
        self._arcs_per_curvature = 0.5 * (_DIRECT_ARCS - 1) / widest
        manoeuvre = np.arange(len(self._first) - 1)
        begin = manoeuvre[:, None] // gains.second_arcs * FIRST_SAMPLES + np.arange(FIRST_SAMPLES)
        end = lead_x.size + manoeuvre[:, None] * SECOND_SAMPLES + np.arange(SECOND_SAMPLES)
        direct = self._tree.shape[1] + np.arange(SAMPLES)
        rows = np.concatenate([np.concatenate([begin, end], axis=1), direct[None]])
        self._samples = np.ascontiguousarray(rows.T)  # (10, T + 1) places of each manoeuvre
        # Added to the squared distances at samples of which the first 0 to 10 are minded.
        unminded = np.arange(SAMPLES) >= np.arange(SAMPLES + 1)[:, None]
        self._unminded_m2 = (_OPEN_M**2 * unminded[..., None]).astype(np.float32)  # (11, 10, 1)
        self._hit_m2 = (robot.body_radius_m + gains.least_clearance_m) ** 2
        self._free_m = (SPACING_M * np.arange(SAMPLES)[:, None]).astype(np.float32)  # before each
        # Part of the wanted clearance that a distance to the nearest return lacks, at most 1.5.
        self._lack_at_0 = 1.0 + robot.body_radius_m / gains.wanted_clearance_m
        self._lack_per_m = 1.0 / gains.wanted_clearance_m
        least_m = max((self._lack_at_0 - _MOST_LACK) / self._lack_per_m, 0.0)
        # To the nearest return, and to the waypoint at the nearest sample and at the last.
        self._least_m2 = np.array([[least_m**2], [0.0], [0.0]], np.float32)
        # Of the change from the waypoint's curvature, that from the present one, the squared lack
        # of clearance, the least distance to the waypoint, how far it ends away from there, the
        # blocked part of the way.
        self._weights = np.array(
            [
                gains.toward_weight / widest,
                gains.change_weight / widest,
                gains.clearance_weight,
                gains.miss_weight_per_m,
                gains.away_weight_per_m,
                gains.blocked_weight,
            ],
            np.float32,
        )

    def choose(
        self,
        toward_per_m: Sequence[float],
        present_per_m: Sequence[float],
        distance_m: Sequence[float],
        lifted: NDArray[np.float32],
    ) -> list[Choice]:
        """Cheapest manoeuvre of each of B robots.

        `toward_per_m` (B,) leads to the waypoint, `distance_m` (B,) away, `present_per_m` (B,) is
        being steered, `lifted` (B, P + 1, 4) are scan and waypoint as of `lift_points`.
        """
        batch, tree = len(lifted), self._tree.shape[1]
        middle = _DIRECT_ARCS // 2
        arcs = [middle + round(toward * self._arcs_per_curvature) for toward in toward_per_m]
        horizons_m = [self._horizon_m(distance) for distance in distance_m]
        minded = [int(horizon / SPACING_M + 0.5) for horizon in horizons_m]

        places = np.empty((batch, 4, tree + SAMPLES), np.float32)
        places[:, :, :tree], places[:, :, tree:] = self._tree, self._direct.take(arcs, axis=0)
        square = lifted @ places  # (B, P + 1, N) m2
        nearest = np.empty((batch, 2, tree + SAMPLES), np.float32)  # return, waypoint
        ahead = square[:, _REAR_POINTS : -1 - _REAR_POINTS]
        np.minimum.reduce(ahead, axis=1, out=nearest[:, 0])
        nearest[:, 1] = square[:, -1]
        samples = nearest.take(self._samples, axis=2)  # (B, 2, 10, T + 1)
        returns = samples[:, 0]
        returns += self._unminded_m2.take(minded, axis=0)
        hit = returns < self._hit_m2

        steered = np.array([toward_per_m, present_per_m], np.float32).T[..., None]  # (B, 2, 1)
        terms = np.empty((batch, 6, len(self._first)), np.float32)
        turned, distances, blocked = terms[:, :2], terms[:, 2:5], terms[:, 5]
        lack, away = terms[:, 2], terms[:, 4]
        np.subtract(self._first, steered, out=turned)
        turned[..., -1] = [
            (0.0, toward - present)
            for toward, present in zip(toward_per_m, present_per_m, strict=True)
        ]
        np.abs(turned, out=turned)
        np.minimum.reduce(samples, axis=2, out=distances[:, :2])
        away[:] = samples[:, 1, -1]
        np.sqrt(np.maximum(distances, self._least_m2), out=distances)
        # Straight past the waypoint is not away from it.
        past_m = [[max(distance, SPACING_M * SAMPLES - distance)] for distance in distance_m]
        np.maximum(away - np.array(past_m, np.float32), 0.0, out=away)
        np.maximum(self._lack_at_0 - self._lack_per_m * lack, 0.0, out=lack)
        lack *= lack
        way_m = np.array([max(horizon, SPACING_M) for horizon in horizons_m], np.float32)
        behind = 1.0 - self._free_m / way_m[:, None, None]  # part of the way behind each sample
        np.maximum.reduce(hit * behind, axis=1, out=blocked)
        best = (self._weights @ terms).argmin(axis=1).tolist()
        return [
            self._choice(
                toward_per_m[row] if at == len(self._first) - 1 else float(self._first[at]),
                returns[row, :, at].tolist(),
            )
            for row, at in enumerate(best)
        ]

    def _horizon_m(self, distance_m: float) -> float:
        """Length of way that counts; a waypoint nearer than usual is the goal, no more does."""
        gains = self._gains
        beyond = gains.beyond_per_m * max(distance_m - gains.near_waypoint_m, 0.0)
        return min(distance_m + beyond, SPACING_M * SAMPLES)

    def _choice(self, curvature_per_m: float, returns_m2: list[float]) -> Choice:
        """What the squared distances from a manoeuvre's samples (10,) to the returns allow."""
        least_m2, free_m = min(returns_m2), _OPEN_M
        if least_m2 < self._hit_m2:
            free_m = SPACING_M * next(i for i, m2 in enumerate(returns_m2) if m2 < self._hit_m2)
        clearance_m = math.sqrt(max(least_m2, 0.0)) - self._robot.body_radius_m
        return Choice(curvature_per_m, clearance_m, free_m)


def _arc(
    curvature_per_m: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places x, y (N, count) each `SPACING_M` along arcs (N,) that leave the origin forward."""
    curvature = (curvature_per_m + (np.abs(curvature_per_m) < 1e-6) * 2e-6)[:, None]
    angle = curvature * (SPACING_M * np.arange(1, count + 1))
    return np.sin(angle) / curvature, (1.0 - np.cos(angle)) / curvature
