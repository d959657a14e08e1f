"""Where a world's rooms are, told from its walls alone."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from cbe_hil_sim.world import World

NECK_M = 0.7  # half the width of the narrowest passage that joins two parts to one room
MARGIN_M = 0.35  # a room ends so far from its walls, and before its doors
SMALLEST_M2 = 1.0  # of what is `NECK_M` from all walls
FROM_CEILING_M = 0.06  # what reaches higher than this below the ceiling is a wall or a lintel


def rooms(world: World) -> NDArray[np.int32]:
    """Number of the room of each free cell (rows, columns), 0 in doors and along walls.

    Furniture parts no rooms, unless nothing reaches the ceiling: then all that blocks is taken for
    walls. Where more than half of the floor is one room, all of it counts as that one.
    """
    high_m = world.ceiling_m - FROM_CEILING_M
    walls = (world.solid_top_m >= high_m) | (world.span_top_m >= high_m)
    if not walls.any():
        walls = world.blocked
    distance_m = ndimage.distance_transform_edt(np.pad(~walls, 1))[1:-1, 1:-1] * world.resolution_m
    cores, count = ndimage.label(distance_m >= NECK_M)
    areas_m2 = np.bincount(cores.ravel(), minlength=count + 1) * world.resolution_m**2
    cores[(areas_m2 < SMALLEST_M2)[cores]] = 0
    if not cores.any():
        return np.zeros(cores.shape, np.int32)
    away, nearest = ndimage.distance_transform_edt(cores == 0, return_indices=True)
    near = away * world.resolution_m <= NECK_M - MARGIN_M
    room = np.where(near & ~world.blocked, cores[tuple(nearest)], 0).astype(np.int32)
    cells = np.bincount(room[room > 0])
    return np.minimum(room, 1) if 2 * cells.max() > cells.sum() else room
