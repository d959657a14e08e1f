"""The demonstration's course: a way through doors, a jittered start and a bin on the way."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from cbe.errors import WorldError
from cbe_bench.jitter import jittered
from cbe_hil_sim.astar import SPACING_M, GoalField, plan
from cbe_hil_sim.demonstrator import start_pose
from cbe_hil_sim.worldbatch import WorldBatch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe_hil_sim.world import World

SHORTEST_M, LONGEST_M = 10.0, 15.0
END_CLEARANCE_M = 0.45  # the jittered start needs room, and a drive should not end in a corner
WAY_CLEARANCE_M = 0.24
LINTEL_M = 1.8  # what spans free floor from above this up to the ceiling is a lintel
DOOR_DISTANCE_POINTS = 16  # no drive begins or ends within 0.8 m of a door
GOALS, STARTS = 40, 6

BIN_M = 0.3
BIN_HEIGHT_M = 1.0
BIN_GAP_M = 0.6
BIN_FROM_ENDS_M = 2.0
BIN_OFFSET_M = 0.25


@dataclass(frozen=True, slots=True)
class Course:
    """A drive to teach: `path` (N, 2) in world metres, a point each 0.05 m, and its doors."""

    path: NDArray[np.float64]
    doors: int

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())

    @property
    def start(self) -> NDArray[np.float64]:
        """Pose (3,) at the path's first point, heading along it."""
        return start_pose(self.path)


def doorways(world: World) -> NDArray[np.int32]:
    """Number of the doorway of each cell (rows, columns); 0 where there is none."""
    lintel = (world.span_bottom_m >= LINTEL_M) & (world.span_top_m >= world.ceiling_m - 0.06)
    labels, _ = ndimage.label(lintel & ~world.blocked)
    return np.asarray(labels, np.int32)


def choose(world: World, seed: int, *, min_doors: int = 2) -> Course:
    """A way of 10 to 15 m through at least `min_doors` doors, the same for the same seed.

    Raises:
        WorldError: the world has no such way.
    """
    rng = np.random.default_rng([seed, 17])
    doors = doorways(world)
    spots = np.argwhere(world.clearance_m >= END_CLEARANCE_M)[:, ::-1]
    points = (spots + 0.5) * world.resolution_m + np.array(world.origin_m)  # (N, 2)
    most = 0
    for _ in range(GOALS if len(points) else 0):
        field = GoalField(world, rng.choice(points))
        cost = field.cost_at(points)
        starts = points[np.isfinite(cost) & (cost >= SHORTEST_M)]
        if not len(starts):
            continue
        for start in rng.choice(starts, STARTS):
            course = _cut(world, field.path(start), doors, rng)
            if course is None:
                continue
            most = max(most, course.doors)
            if course.doors >= min_doors:
                return course
    raise WorldError(
        f"world {world.name!r} offers no way of {SHORTEST_M:.0f} to {LONGEST_M:.0f} m through "
        f"{min_doors} doors (found {most}); choose another seed or scene"
    )


def _cut(
    world: World,
    path: NDArray[np.float64],
    doors: NDArray[np.int32],
    rng: np.random.Generator,
) -> Course | None:
    """The part of a path, within the lengths allowed, that passes the most doors; None if none."""
    clearance = world.clearance_at(path)
    crossed = doors[world.cells(path)]
    shortest = math.ceil(SHORTEST_M / SPACING_M) + 1
    points = min(len(path), int(rng.integers(shortest, int(LONGEST_M / SPACING_M) + 1)))
    best: Course | None = None
    for first in range(0, len(path) - points + 1, 10):
        part = slice(first, first + points)
        near_ends = crossed[part][:DOOR_DISTANCE_POINTS], crossed[part][-DOOR_DISTANCE_POINTS:]
        if (
            points < shortest
            or min(clearance[first], clearance[first + points - 1]) < END_CLEARANCE_M
            or clearance[part].min() < WAY_CLEARANCE_M
            or np.any(near_ends)
        ):
            continue
        passed = len(set(crossed[part].tolist()) - {0})
        if best is None or passed > best.doors:
            best = Course(path[part], passed)
    return best


def jittered_start(world: World, pose: NDArray[np.floating], seed: int) -> NDArray[np.float64]:
    """A pose (3,) near `pose` (3,) as the paper jitters it (`cbe_bench.jitter`).

    Raises:
        WorldError: there is no room around the pose.
    """
    rng = np.random.default_rng([seed, 23])
    start = jittered(world, WorldBatch.pack([world]), pose, 1.0, rng)
    if start is None:
        raise WorldError(f"there is no room for a jittered start around {pose.round(2).tolist()}")
    return start


def bin_place(world: World, poses: NDArray[np.floating], seed: int) -> NDArray[np.float64]:
    """Place and heading (3,) of a bin on a drive's way (T, 3) that leaves a way past it.

    Raises:
        WorldError: no place leaves 0.6 m on one side.
    """
    rng = np.random.default_rng([seed, 29])
    ends = poses[[0, -1], :2]
    away = np.hypot(*(poses[:, None, :2] - ends).transpose(2, 0, 1)).min(axis=1)  # (T,)
    candidates = np.flatnonzero(away > BIN_FROM_ENDS_M)
    for index in rng.permutation(candidates):
        x, y, yaw = poses[index]
        left = np.array([-math.sin(yaw), math.cos(yaw)])
        centre = np.array([x, y]) + rng.uniform(-BIN_OFFSET_M, BIN_OFFSET_M) * left
        gaps = [_free_m(world, centre, side * left) - 0.5 * BIN_M for side in (1.0, -1.0)]
        if max(gaps) >= BIN_GAP_M and min(gaps) >= 0.0 and _way_past(world, ends, centre):
            return np.array([*centre, yaw])
    raise WorldError(f"no place on the way leaves {BIN_GAP_M} m beside a bin; choose another seed")


def _free_m(world: World, point: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
    """Metres from a point (2,) along a unit direction (2,) to the first blocked cell."""
    steps = np.arange(0.0, 2.0, 0.5 * world.resolution_m)
    blocked = world.blocked[world.cells(point + steps[:, None] * direction)]
    return float(steps[int(blocked.argmax())] if blocked.any() else steps[-1])


def _way_past(world: World, ends: NDArray[np.floating], centre: NDArray[np.float64]) -> bool:
    """Whether a robot gets from one end to the other with the bin in place."""
    standing = world.with_cylinder(
        float(centre[0]), float(centre[1]), BIN_M * math.sqrt(0.5), BIN_HEIGHT_M, 0
    )
    try:
        plan(standing, ends[0], ends[1])
    except WorldError:
        return False
    return True
