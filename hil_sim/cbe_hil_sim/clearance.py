"""Distance to the nearest obstacle for many robots in many worlds at once."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cbe_hil_sim.world import World


class Clearance:
    """The clearance grids of several worlds, read between cell centres.

    Interpolated because the grid's 0.05 m are half of the clearance that matters.
    """

    def __init__(self, worlds: Sequence[World]) -> None:
        """Flatten the worlds' `clearance_m`; index w of the arrays is `worlds[w]`."""
        shapes = np.array([world.clearance_m.shape for world in worlds], np.int64)
        self._shape = shapes
        self._first = np.cumsum([0, *shapes.prod(axis=1)[:-1]])
        self._origin = np.array([world.origin_m for world in worlds], np.float64)
        self._resolution = np.array([world.resolution_m for world in worlds], np.float64)
        self._grid = np.concatenate([world.clearance_m.ravel() for world in worlds])

    def at(
        self, world_index: NDArray[np.integer], points_m: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Metres from world points (B, 2) to the nearest blocked cell's edge, (B,)."""
        place = (points_m - self._origin[world_index]) / self._resolution[world_index, None] - 0.5
        highest = self._shape[world_index, ::-1] - 1.0
        place = np.clip(place, 0.0, highest)
        low = np.minimum(np.floor(place), highest - 1.0).astype(np.int64)
        right, up = (place - low).T
        columns = self._shape[world_index, 1]
        cell = self._first[world_index] + low[:, 1] * columns + low[:, 0]
        grid = self._grid
        below = grid[cell] * (1.0 - right) + grid[cell + 1] * right
        above = grid[cell + columns] * (1.0 - right) + grid[cell + columns + 1] * right
        return np.asarray(below * (1.0 - up) + above * up, dtype=np.float32)
