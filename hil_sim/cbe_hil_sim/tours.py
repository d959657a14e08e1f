"""Tours: ways through a world from one place to another and on, with the turns between them."""

import math

import numpy as np
from numpy.typing import NDArray

from cbe_hil_sim.astar import SPACING_M, GoalField
from cbe_hil_sim.demonstrator import ENDPOINT_CLEARANCE_M
from cbe_hil_sim.world import World

_TRIES = 100
_LEG_POINTS, _LEG_SHARE, _LEG_TRIES = 20, 0.7, 8
SHARPEST_RAD = math.radians(90.0)
"""From leg to leg: a driver whose car cannot reverse looks for room before turning back."""
HAIRPIN_RAD = math.radians(150.0)
"""The car's limit, at full lock for half a turn: some such drives fail, and those are left out."""


def tour(
    world: World,
    rng: np.random.Generator,
    length_m: float,
    places: NDArray[np.float64],
    sharpest_rad: float = SHARPEST_RAD,
) -> NDArray[np.float64] | None:
    """A path (N, 2) towards one of the `places` (K, 2) after another, or None."""
    if len(places) == 0:
        return None
    start, legs, refused = rng.choice(places), list[NDArray[np.float64]](), 0
    for _ in range(_TRIES):
        here = legs[-1][-1] if legs else start
        field = GoalField(world, rng.choice(places))
        reachable = np.isfinite(field.cost_at(here[None])[0])
        leg = field.path(here) if reachable else here[None]
        if len(leg) >= _LEG_POINTS and (not legs or _turn(legs[-1], leg) <= sharpest_rad):
            legs.append(leg[: max(_LEG_POINTS, round(_LEG_SHARE * len(leg)))])
            refused = 0
            if sum(map(len, legs)) * SPACING_M >= length_m:
                return np.concatenate(legs)
            continue
        refused += 1
        if refused >= _LEG_TRIES:  # a dead end: the last leg leads into a corner
            start, refused = rng.choice(places) if not legs else start, 0
            del legs[-1:]
    return None


def roomy(world: World) -> NDArray[np.float64]:
    """Places (K, 2) in the middle of rooms: a way that is cut short there goes on ahead."""
    clear_m = world.clearance_m[world.clearance_m >= ENDPOINT_CLEARANCE_M]
    if len(clear_m) == 0:
        return np.empty((0, 2))
    return middles(world, world.clearance_m >= np.quantile(clear_m, 0.6))


def middles(world: World, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Middles (K, 2) of the chosen cells (rows, columns)."""
    cells = np.argwhere(chosen)[:, ::-1]
    points: NDArray[np.float64] = (cells + 0.5) * world.resolution_m + np.array(world.origin_m)
    return points


def _turn(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Angle between the end of one path and the beginning of the next."""
    a, b = before[-1] - before[-7], after[6] - after[0]
    return abs(math.atan2(float(a[0] * b[1] - a[1] * b[0]), float(a @ b)))
