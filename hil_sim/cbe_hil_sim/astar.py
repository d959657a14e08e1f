"""Global paths: least-cost routes through a world's free space that keep away from walls."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.graph import MCP_Geometric

from cbe.errors import WorldError
from cbe_hil_sim.world import World

COARSENING = 2  # cells of the world to one cell of the search
COMFORT_M = 0.45  # nothing is gained by more distance to walls
WALL_COST = 12.0
SPACING_M = 0.05
SNAP_CELLS = 2  # how far a start or goal may lie from passable cells
SMOOTHING_M = 0.25  # makes corners driveable at a turning radius of 0.43 m
_SMOOTHING_ROUNDS = 12


class GoalField:
    """Least-cost ways from everywhere to one goal, searched once and traced for many starts."""

    def __init__(
        self, world: World, goal_m: NDArray[np.floating], *, clearance_m: float = 0.2
    ) -> None:
        """Search the whole world from `goal_m` (2,); WorldError if the goal is not free."""
        self.world = world
        self.goal_m = np.asarray(goal_m, dtype=np.float64)
        self._clearance_m = clearance_m
        coarse = _coarse_clearance(world)
        self._size_m = COARSENING * world.resolution_m
        nearness = np.clip((COMFORT_M - coarse) / COMFORT_M, 0.0, 1.0)
        cost = np.where(coarse >= clearance_m, 1.0 + WALL_COST * nearness**2, -1.0)
        self._mcp = MCP_Geometric(cost)  # negative costs are impassable
        self._passable = cost > 0.0
        goal = self._nearest_passable(self.goal_m)
        if goal is None:
            raise WorldError(
                f"goal {tuple(self.goal_m.round(2))} lies within {clearance_m} m of an obstacle "
                f"in world {world.name!r}; choose a free goal or lower the clearance"
            )
        costs, _ = self._mcp.find_costs([goal])
        self.cost_m: NDArray[np.float64] = costs * self._size_m  # inf where there is no way

    def cost_at(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Cost to the goal from world points (N, 2): at least the distance in metres."""
        row, column = self._cells(points_m)
        return self.cost_m[row, column]

    def path(self, start_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Smooth path (N, 2) from `start_m` (2,) to the goal, a point each 0.05 m."""
        cell = self._nearest_passable(np.asarray(start_m))
        if cell is None or not np.isfinite(self.cost_m[cell]):
            raise WorldError(
                f"no way from {tuple(np.round(start_m, 2))} to {tuple(self.goal_m.round(2))} in "
                f"world {self.world.name!r} with clearance {self._clearance_m} m"
            )
        cells = np.array(self._mcp.traceback(cell)[::-1], dtype=np.float64)  # (N, 2) row, column
        points = (cells[:, ::-1] + 0.5) * self._size_m + np.array(self.world.origin_m)
        points[0], points[-1] = start_m, self.goal_m
        return self._smooth(_resample(points, SPACING_M))

    def _smooth(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Elastic band: rounds corners, then steps back from walls, ends held."""
        sigma = SMOOTHING_M / SPACING_M / np.sqrt(_SMOOTHING_ROUNDS)
        for _ in range(_SMOOTHING_ROUNDS):
            if len(points) < 3:
                break
            points = _filter_with_held_ends(points, sigma * 1.5)
            away, lacking = _push(self.world, points)
            points[1:-1] += 0.35 * (away * lacking[:, None])[1:-1]
        points = _filter_with_held_ends(points, 2.0)
        return _resample(points, SPACING_M)

    def _cells(self, points_m: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        rows, columns = self.cost_shape
        cell = np.floor((np.asarray(points_m) - self.world.origin_m) / self._size_m).astype(np.intp)
        return np.clip(cell[..., 1], 0, rows - 1), np.clip(cell[..., 0], 0, columns - 1)

    @property
    def cost_shape(self) -> tuple[int, int]:
        """Rows and columns of the search grid."""
        rows, columns = self.world.solid_top_m.shape
        return -(-rows // COARSENING), -(-columns // COARSENING)

    def _nearest_passable(self, point_m: NDArray[np.floating]) -> tuple[int, int] | None:
        """Passable cell nearest to a point (2,), for those that stand a little too close."""
        row, column = self._cells(point_m)
        low = np.maximum([row - SNAP_CELLS, column - SNAP_CELLS], 0)
        window = self._passable[low[0] : row + SNAP_CELLS + 1, low[1] : column + SNAP_CELLS + 1]
        free = np.argwhere(window) + low  # (N, 2)
        if len(free) == 0:
            return None
        nearest = free[((free - [row, column]) ** 2).sum(axis=1).argmin()]
        return int(nearest[0]), int(nearest[1])


def plan(
    world: World,
    start_m: NDArray[np.floating],
    goal_m: NDArray[np.floating],
    *,
    clearance_m: float = 0.2,
) -> NDArray[np.float64]:
    """Path (N, 2) from start (2,) to goal (2,), a point each 0.05 m; WorldError without a way."""
    return GoalField(world, goal_m, clearance_m=clearance_m).path(start_m)


def _coarse_clearance(world: World) -> NDArray[np.float32]:
    """Least clearance of each block of cells (rows, columns)."""
    rows, columns = world.clearance_m.shape
    pad = ((0, -rows % COARSENING), (0, -columns % COARSENING))
    padded = np.pad(world.clearance_m, pad)  # outside there is nothing to stand on
    blocks = padded.reshape(
        padded.shape[0] // COARSENING, COARSENING, padded.shape[1] // COARSENING, COARSENING
    )  # (R, k, C, k)
    return np.asarray(blocks.min(axis=(1, 3)))


def _resample(points: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """Points (N, 2) at equal distances along a polyline, both ends kept."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    count = max(2, round(length[-1] / spacing_m) + 1)
    at = np.linspace(0.0, length[-1], count)
    return np.stack([np.interp(at, length, points[:, axis]) for axis in (0, 1)], axis=-1)


def _filter_with_held_ends(points: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Gaussian smoothing along the path; the deviation from the chord is what is smoothed."""
    chord = np.linspace(points[0], points[-1], len(points))
    deviation = points - chord
    # Odd continuation about the ends keeps them in place.
    pad = min(len(points) - 1, int(4 * sigma) + 1)
    before, after = -deviation[pad:0:-1], -deviation[-2 : -pad - 2 : -1]
    padded = np.concatenate([before, deviation, after])
    smooth = ndimage.gaussian_filter1d(padded, sigma, axis=0, mode="nearest")
    return np.asarray(chord + smooth[pad : pad + len(points)])


def _push(
    world: World, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit direction (N, 2) away from obstacles and the clearance (N,) that lacks to comfort."""
    step = world.resolution_m
    dx = np.array([step, 0.0])
    dy = np.array([0.0, step])
    gradient = np.stack(
        [
            world.clearance_at(points + dx) - world.clearance_at(points - dx),
            world.clearance_at(points + dy) - world.clearance_at(points - dy),
        ],
        axis=-1,
    ).astype(np.float64) / (2.0 * step)  # (N, 2), shorter than 1 between two walls
    lacking = np.maximum(COMFORT_M - world.clearance_at(points), 0.0).astype(np.float64)
    return gradient, lacking
