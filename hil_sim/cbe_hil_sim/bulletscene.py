"""A 2.5-D world as pybullet sees it: equal cells merged to rectangles, same colours and UVs."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cbe_hil_sim.scene import Patch, Scene
from cbe_hil_sim.world import SHADES, World

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

X, Y, Z = 0, 1, 2


@dataclass(frozen=True, slots=True)
class _Quads:
    """Axis-parallel rectangles with one outward normal: low and high corners (Q, 3) in metres."""

    axis: int
    positive: bool
    low_m: Floats
    high_m: Floats
    surface: Ints  # (Q,)

    @property
    def shade(self) -> float:
        """Brightness by the normal."""
        return SHADES[2 * self.axis + self.positive]

    def triangles(self) -> Floats:
        """Corners (Q * 2, 3, 3), counter-clockwise seen from outside."""
        across, along = ((Y, Z), (X, Z), (X, Y))[self.axis]
        corners = np.repeat(self.low_m[:, None], 4, axis=1)  # (Q, 4, 3)
        corners[:, 1:3, across] = self.high_m[:, None, across]
        corners[:, 2:, along] = self.high_m[:, None, along]
        # x cross z points along -y, so that pair turns the other way.
        if self.positive == (self.axis == Y):
            corners = corners[:, ::-1]
        return corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)


def scene_from_world(world: World) -> Scene:
    """Build the pybullet view of `world`; as in the column view, it is solid outside its grid."""
    blank = np.zeros_like(world.solid_side)
    shape_only = replace(world, solid_side=blank, solid_cap=blank, span_surface=blank)
    solid = [quads.triangles() for quads in (*_sides(shape_only), *_caps(shape_only))]
    return Scene(
        name=world.name,
        patches=_patches(world, [*_sides(world), *_caps(world), *_levels(world)]),
        solid_m=np.concatenate(solid),
        planning=world,
    )


def _patches(world: World, faces: list[_Quads]) -> list[Patch]:
    """Group the faces by texture and final colour factor (texture * tint * shade)."""
    surfaces = world.surfaces
    groups: dict[tuple[int, bytes], list[tuple[Floats, Floats]]] = {}
    for quads in faces:
        triangles = quads.triangles().reshape(-1, 6, 3)  # (Q, 6, 3)
        across, up = ((Y, Z), (X, Z), (X, Y))[quads.axis]
        origin, size = surfaces.origin_m[quads.surface], surfaces.size_m[quads.surface]
        uv = (triangles - origin[:, None])[..., [across, up]] / size[:, None]  # (Q, 6, 2)
        uv -= np.floor(uv.min(axis=1, keepdims=True))
        for surface in np.unique(quads.surface):
            factor = (surfaces.tint[surface] * np.float32(quads.shade)).astype(np.float32)
            chosen = quads.surface == surface
            groups.setdefault((int(surfaces.texture[surface]), factor.tobytes()), []).append(
                (triangles[chosen].reshape(-1, 3, 3), uv[chosen].reshape(-1, 3, 2))
            )
    patches = []
    for (texture, factor_bytes), parts in groups.items():
        colour = world.textures[texture] * np.frombuffer(factor_bytes, np.float32)
        image = np.minimum(colour + np.float32(0.5), 255.0).astype(np.uint8)
        corners, uvs = zip(*parts, strict=True)
        patches.append(Patch(np.concatenate(corners), np.concatenate(uvs), image))
    return patches


def _clipped(world: World) -> tuple[Floats, Floats, Floats]:
    """Solid top, span bottom and span top, kept under the ceiling and out of one another."""
    solid = np.minimum(world.solid_top_m, np.float32(world.ceiling_m))
    top = np.minimum(world.span_top_m, np.float32(world.ceiling_m))
    bottom = np.maximum(world.span_bottom_m, solid)
    return solid, bottom, np.where(top > bottom, top, np.float32(0.0))


def _sides(world: World) -> Iterator[_Quads]:
    """Vertical faces of solids and spans."""
    for axis in (X, Y):
        # Lines of cells along the axis, with the wall that encloses the world at both ends.
        solid, bottom, top = (
            np.pad(_lines(grid, axis), ((0, 0), (1, 1)), constant_values=outside)
            for grid, outside in zip(_clipped(world), (world.ceiling_m, 0.0, 0.0), strict=True)
        )
        side, span = (
            np.pad(_lines(grid, axis), ((0, 0), (1, 1)), mode="edge").astype(np.int64)
            for grid in (world.solid_side, world.span_surface)
        )
        before, after = np.s_[:, :-1], np.s_[:, 1:]
        for own, other, positive in ((before, after, True), (after, before, False)):
            yield _side(
                world, axis, positive, solid[other], solid[own], side[own],
                solid[own] > solid[other],
            )  # fmt: skip
            covered = (top[other] >= top[own]) & (bottom[other] <= bottom[own])
            lowest = np.maximum(bottom[own], solid[other])
            yield _side(
                world, axis, positive, lowest, top[own], span[own], ~covered & (top[own] > lowest)
            )


def _side(
    world: World,
    axis: int,
    positive: bool,
    low_m: Floats,
    high_m: Floats,
    surface: Ints,
    present: NDArray[np.bool_],
) -> _Quads:
    """Merge faces between cells, grids (lines, cells + 1), across the lines."""
    key, index = _keys(present, surface, low_m, high_m)
    line, end_line, place, _ = _runs(key.T)
    chosen = index[line, place]  # first face of each run
    low, high = np.empty((2, len(chosen), 3), np.float32)
    other = Y if axis == X else X
    cell_m, origin = world.resolution_m, world.origin_m
    low[:, axis] = high[:, axis] = origin[axis] + place * cell_m
    low[:, other], high[:, other] = origin[other] + line * cell_m, origin[other] + end_line * cell_m
    low[:, Z], high[:, Z] = low_m.ravel()[chosen], high_m.ravel()[chosen]
    return _Quads(axis, positive, low, high, surface.ravel()[chosen])


def _caps(world: World) -> Iterator[_Quads]:
    """Horizontal faces of solids and spans."""
    solid, bottom, top = _clipped(world)
    ceiling = np.float32(world.ceiling_m)
    yield _level(world, True, solid, world.solid_cap, (solid > 0.0) & (solid < ceiling))
    yield _level(world, True, top, world.span_surface, (top > 0.0) & (top < ceiling))
    yield _level(world, False, bottom, world.span_surface, (top > 0.0) & (bottom > solid))


def _levels(world: World) -> Iterator[_Quads]:
    """Floor and ceiling, where they are open."""
    solid, _, _ = _clipped(world)
    ceiling = np.full_like(solid, world.ceiling_m)
    yield _level(world, True, np.zeros_like(solid), world.floor_surface, solid <= 0.0)
    yield _level(world, False, ceiling, world.ceiling_surface, solid < ceiling)


def _level(
    world: World,
    positive: bool,
    height_m: Floats,
    surface: NDArray[np.uint16],
    present: NDArray[np.bool_],
) -> _Quads:
    """Merge horizontal faces of equal height and surface, grids (rows, columns)."""
    key, index = _keys(present, surface.astype(np.int64), height_m, height_m)
    column, end_column, row, end_row = _rectangles(key)
    chosen = index[row, column]
    low, high = np.empty((2, len(chosen), 3), np.float32)
    cell_m, (x_m, y_m) = world.resolution_m, world.origin_m
    low[:, X], high[:, X] = x_m + column * cell_m, x_m + end_column * cell_m
    low[:, Y], high[:, Y] = y_m + row * cell_m, y_m + end_row * cell_m
    low[:, Z] = high[:, Z] = height_m.ravel()[chosen]
    return _Quads(Z, positive, low, high, surface.ravel()[chosen].astype(np.int64))


def _lines(grid: NDArray[np.generic], axis: int) -> NDArray[np.generic]:
    """Grid whose second index runs along the axis."""
    return grid if axis == X else grid.T


def _keys(
    present: NDArray[np.bool_], surface: Ints, low_m: Floats, high_m: Floats
) -> tuple[Ints, Ints]:
    """Number the kinds of faces: grid of the kind, -1 where absent, and grid of flat indices."""
    kinds = np.stack(
        [surface[present], np.rint(low_m[present] * 1e5), np.rint(high_m[present] * 1e5)], axis=-1
    ).astype(np.int64)  # (N, 3)
    key = np.full(present.shape, -1, np.int64)
    if len(kinds):
        folded = (kinds[:, 0] << 48) + (kinds[:, 1] << 24) + kinds[:, 2]
        key[present] = np.unique(folded, return_inverse=True)[1]
    return key, np.arange(present.size).reshape(present.shape)


def _runs(key: Ints) -> tuple[Ints, Ints, Ints, Ints]:
    """Runs of equal keys along the lines of (L, N): start, end, line and key of each."""
    edge = np.ones((key.shape[0], key.shape[1] + 1), np.bool_)
    edge[:, 1:-1] = key[:, 1:] != key[:, :-1]
    line, start = np.nonzero(edge[:, :-1])
    _, last = np.nonzero(edge[:, 1:])
    kind = key[line, start]
    keep = kind >= 0
    return start[keep], last[keep] + 1, line[keep], kind[keep]


def _rectangles(key: Ints) -> tuple[Ints, Ints, Ints, Ints]:
    """Rectangles of equal keys: first and end column, first and end row of each."""
    start, end, row, kind = _runs(key)
    order = np.lexsort((row, end, start, kind))
    start, end, row, kind = start[order], end[order], row[order], kind[order]
    same = (np.diff(start) == 0) & (np.diff(end) == 0) & (np.diff(kind) == 0)
    first = np.ones(len(row), np.bool_)
    first[1:] = ~(same & (np.diff(row) == 1))
    last = np.roll(first, -1)  # a rectangle ends where the next begins
    return start[first], end[first], row[first], row[last] + 1
