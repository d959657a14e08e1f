"""Short manoeuvres, two arcs each, scored against the scan: which way round an obstacle to go.

Repulsion alone, and a single arc too, drive into dead ends beside an obstacle; a second arc
shows early enough whether the car, which cannot reverse, will get out again behind it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cbe.nearness import lift_places
from cbe.robot import Robot

Floats = NDArray[np.floating]

SPACING_M = 0.12  # between the checked places of a manoeuvre
FIRST_SAMPLES, SECOND_SAMPLES = 3, 7
SAMPLES = FIRST_SAMPLES + SECOND_SAMPLES
_OPEN_M = 10.0  # clearance and free length where nothing is near
_REAR_POINTS = 4  # on each side, of 48: 100 deg and more from ahead, forward drives only leave them
_DIRECT_ARCS = 257  # to the waypoint; the nearest one is less than 7 mm off at its end


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
        self._tree = lift_places(np.append(lead_x, x), np.append(lead_y, y))
        arcs = np.linspace(-widest, widest, _DIRECT_ARCS)
        self._direct = lift_places(*_arc(arcs, SAMPLES)).swapaxes(0, 1).copy()  # (A, 4, 10)
        self._arcs_per_curvature = 0.5 * (_DIRECT_ARCS - 1) / widest
        manoeuvre = np.arange(len(self._first))
        begin = manoeuvre[:, None] // gains.second_arcs * FIRST_SAMPLES + np.arange(FIRST_SAMPLES)
        end = lead_x.size + manoeuvre[:, None] * SECOND_SAMPLES + np.arange(SECOND_SAMPLES)
        direct = self._tree.shape[1] + np.arange(SAMPLES)  # the arc to the waypoint comes last
        rows = np.concatenate([np.concatenate([begin, end], axis=1), direct[None]])
        self._samples = np.ascontiguousarray(rows.T)  # (10, T + 1) places of each manoeuvre
        self._minded_m = (SPACING_M * (np.arange(SAMPLES) + 0.5)).astype(np.float32)
        self._hit_m2 = np.float32((robot.body_radius_m + gains.least_clearance_m) ** 2)
        # Free length where the first sample to hit is 0 to 9, or none.
        self._free_m = np.append(SPACING_M * np.arange(SAMPLES), _OPEN_M)
        # Of the change from the waypoint's curvature, that from the present one, the nearest
        # distance to the waypoint, the squared lack of clearance, the blocked part of the way.
        self._weights = np.array(
            [
                gains.toward_weight / widest,
                gains.change_weight / widest,
                gains.miss_weight_per_m,
                gains.clearance_weight,
                gains.blocked_weight,
            ]
        )

    def choose(
        self,
        toward_per_m: NDArray[np.float64],
        present_per_m: NDArray[np.float64],
        distance_m: NDArray[np.float64],
        lifted: NDArray[np.float32],
    ) -> Choice:
        """Cheapest manoeuvre of each of B robots.

        `toward_per_m` (B,) leads to the waypoint, `distance_m` (B,) away, `present_per_m` (B,) is
        being steered, `lifted` (B, 1 + P, 4) are waypoint and scan as of `lift_points`.
        """
        gains = self._gains
        batch, tree = len(lifted), self._tree.shape[1]
        places = np.empty((batch, 4, tree + SAMPLES), np.float32)
        places[:, :, :tree] = self._tree
        arc = np.rint(toward_per_m * self._arcs_per_curvature).astype(np.intp)
        places[:, :, tree:] = self._direct.take(arc + _DIRECT_ARCS // 2, axis=0)
        square = lifted @ places  # (B, 1 + P, N)

        # A waypoint nearer than usual is the goal: nothing behind it matters.
        beyond = gains.beyond_per_m * np.maximum(distance_m - gains.near_waypoint_m, 0.0)
        horizon = np.minimum(distance_m + beyond, SPACING_M * SAMPLES)[:, None]
        ahead = square[:, 1 + _REAR_POINTS : -_REAR_POINTS]
        sample = ahead.min(axis=1).take(self._samples, axis=1)  # (B, 10, T + 1) m2
        sample += ((self._minded_m > horizon) * np.float32(_OPEN_M**2))[..., None]
        hit = np.empty((batch, SAMPLES + 1, sample.shape[2]), np.bool_)
        hit[:, :-1], hit[:, -1] = sample < self._hit_m2, True
        hit_at = hit.argmax(axis=1)  # (B, T + 1)
        clearance = np.sqrt(np.maximum(sample.min(axis=1), 0.0)) - self._robot.body_radius_m
        short = np.minimum(np.maximum(1.0 - clearance / gains.wanted_clearance_m, 0.0), 1.5)
        miss = square[:, 0].take(self._samples, axis=1).min(axis=1)

        first = np.empty(clearance.shape)
        first[:, :-1], first[:, -1] = self._first, toward_per_m
        terms = np.empty((batch, 5, first.shape[1]))
        terms[:, 0] = np.abs(first - toward_per_m[:, None])
        terms[:, 1] = np.abs(first - present_per_m[:, None])
        terms[:, 2] = np.sqrt(np.maximum(miss, 0.0))
        terms[:, 3] = short * short
        terms[:, 4] = 1.0 - np.minimum(
            self._free_m.take(hit_at) / np.maximum(horizon, SPACING_M), 1.0
        )
        best = (self._weights @ terms).argmin(axis=1) + np.arange(batch) * first.shape[1]
        free_m = self._free_m.take(hit_at.take(best))
        return Choice(first.take(best), clearance.take(best), free_m)


def _arc(
    curvature_per_m: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places x, y (N, count) each `SPACING_M` along arcs (N,) that leave the origin forward."""
    curvature = (curvature_per_m + (np.abs(curvature_per_m) < 1e-6) * 2e-6)[:, None]
    angle = curvature * (SPACING_M * np.arange(1, count + 1))
    return np.sin(angle) / curvature, (1.0 - np.cos(angle)) / curvature
