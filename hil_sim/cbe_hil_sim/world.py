"""A 2.5-D world: per cell a solid from the floor and one hanging span, under a flat ceiling."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from cbe.errors import WorldError

RESOLUTION_M = 0.05
BLOCKING_HEIGHT_M = 1.1  # the camera's mast must pass under what hangs (design: robot body)
FLOOR_TOLERANCE_M = 0.03  # lower edges are driven over

# Faces by their outward normal, and how bright a fixed directional light makes each.
NEGATIVE_X, POSITIVE_X, NEGATIVE_Y, POSITIVE_Y, DOWN, UP = range(6)
SHADES = (0.82, 0.95, 0.88, 1.0, 0.7, 1.0)
BIN_SIZE_M = (0.3, 0.3, 1.0)  # the paper's trash can


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Table of S surfaces: which texture, how it lies on the faces, and its tint.

    Texture coordinates repeat with period 1. With hit point (x, y, z):
    a vertical face whose normal is along x has u = (y - oy) / width, v = (z - oz) / height;
    a vertical face whose normal is along y has u = (x - ox) / width, v = (z - oz) / height;
    a horizontal face has u = (x - ox) / width, v = (y - oy) / height.
    Texture column = frac(u) * N, texture row = (1 - frac(v)) * N (row 0 is the top).
    Final colour = texture * tint * shade of the face, clipped to 255.
    """

    texture: NDArray[np.int32]  # (S,) index into the texture bank
    origin_m: NDArray[np.float32]  # (S, 3)
    size_m: NDArray[np.float32]  # (S, 2) width, height of one texture repeat
    tint: NDArray[np.float32]  # (S, 3) RGB factors, about 0.2 to 1.3


@dataclass(frozen=True, slots=True)
class World:
    """Grids (rows, columns) = (y, x) of square cells; cell (0, 0) starts at `origin_m`.

    Heights in metres above the floor at z = 0. A span is absent where its top is 0.
    Surface grids hold rows of `surfaces`. `textures` is (N, 128, 128, 3) uint8 RGB,
    shared between worlds of one split.
    """

    solid_top_m: NDArray[np.float32]  # 0 where the floor is free
    span_bottom_m: NDArray[np.float32]
    span_top_m: NDArray[np.float32]
    solid_side: NDArray[np.uint16]
    solid_cap: NDArray[np.uint16]  # the solid's upper face
    span_surface: NDArray[np.uint16]  # every face of the span
    floor_surface: NDArray[np.uint16]
    ceiling_surface: NDArray[np.uint16]
    ceiling_m: float
    surfaces: Surfaces
    textures: NDArray[np.uint8]
    origin_m: tuple[float, float] = (0.0, 0.0)
    resolution_m: float = RESOLUTION_M
    name: str = ""
    clearance_m: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        """Check the grids' shapes and derive `clearance_m`, metres to the nearest blocked cell."""
        shape = self.solid_top_m.shape
        grids = (
            self.span_bottom_m, self.span_top_m, self.solid_side, self.solid_cap,
            self.span_surface, self.floor_surface, self.ceiling_surface,
        )  # fmt: skip
        if len(shape) != 2 or any(grid.shape != shape for grid in grids):
            shapes = [shape, *(grid.shape for grid in grids)]
            raise WorldError(f"grids of one world must share one 2-D shape; found {shapes}")
        clearance = ndimage.distance_transform_edt(~self.blocked) * self.resolution_m
        clearance = np.maximum(clearance - 0.5 * self.resolution_m, 0.0)
        object.__setattr__(self, "clearance_m", clearance.astype(np.float32))

    @property
    def blocked(self) -> NDArray[np.bool_]:
        """Cells (rows, columns) that the robot's body or mast cannot enter."""
        hanging = (self.span_top_m > FLOOR_TOLERANCE_M) & (self.span_bottom_m < BLOCKING_HEIGHT_M)
        return (self.solid_top_m > FLOOR_TOLERANCE_M) | hanging

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent along x and y."""
        rows, columns = self.solid_top_m.shape
        return columns * self.resolution_m, rows * self.resolution_m

    def cells(self, points_m: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row and column indices of world points (..., 2), clipped to the grid."""
        rows, columns = self.solid_top_m.shape
        column = np.floor((points_m[..., 0] - self.origin_m[0]) / self.resolution_m)
        row = np.floor((points_m[..., 1] - self.origin_m[1]) / self.resolution_m)
        row = np.clip(row, 0, rows - 1).astype(np.intp)
        return row, np.clip(column, 0, columns - 1).astype(np.intp)

    def clearance_at(self, points_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Metres from world points (..., 2) to the nearest blocked cell."""
        return self.clearance_m[self.cells(points_m)]

    def with_cylinder(
        self, x_m: float, y_m: float, radius_m: float, height_m: float, surface: int
    ) -> "World":
        """Return a copy with an upright cylinder (a bin) standing on the floor."""
        rows, columns = self.solid_top_m.shape
        cx = self.origin_m[0] + (np.arange(columns) + 0.5) * self.resolution_m
        cy = self.origin_m[1] + (np.arange(rows) + 0.5) * self.resolution_m
        inside = (cx[None, :] - x_m) ** 2 + (cy[:, None] - y_m) ** 2 <= radius_m**2
        solid_top, side, cap = (
            self.solid_top_m.copy(), self.solid_side.copy(), self.solid_cap.copy(),
        )  # fmt: skip
        solid_top[inside] = np.maximum(solid_top[inside], height_m)
        side[inside] = surface
        cap[inside] = surface
        return replace(self, solid_top_m=solid_top, solid_side=side, solid_cap=cap)
