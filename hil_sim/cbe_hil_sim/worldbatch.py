"""Many worlds flattened into contiguous arrays, as the compiled march reads them."""

import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from cbe.errors import WorldError
from cbe_hil_sim.world import SHADES, World

TEXTURE_SIZE = 128
LEVELS = 8  # 128, 64, ..., 1 texels wide
TEXELS = sum((TEXTURE_SIZE >> level) ** 2 for level in range(LEVELS))

BLOCK_BITS = 3
BLOCK = 1 << BLOCK_BITS  # cells along the side of a block
HOLDS = 0x80  # bit of `WorldBatch.skip`: the cell holds something
REACH = 0x7F  # its other bits
KINDS = 1 << 16  # of cells in a world at most

_pyramids: dict[int, tuple[weakref.ref[NDArray[np.uint8]], NDArray[np.uint8]]] = {}


class WorldBatch(NamedTuple):
    """W worlds, their C cells, K kinds of cells and S surfaces one after the other.

    The cells of world w begin at `first_cell[w]`, in blocks of 8 x 8; a cell's kind k is row
    `first_kind[w] + k` of the kinds' arrays, and a kind's surface s is row `first_surface[w] + s`
    of the surface arrays. Blocks, and few bytes a cell, keep what a ray passes in the cache.
    A tuple, because numba takes it as it is.
    """

    first_cell: NDArray[np.int64]  # (W,)
    first_kind: NDArray[np.int64]  # (W,)
    first_surface: NDArray[np.int64]  # (W,)
    shape: NDArray[np.int64]  # (W, 2) rows, columns
    origin_m: NDArray[np.float64]  # (W, 2)
    resolution_m: NDArray[np.float64]  # (W,)
    ceiling_m: NDArray[np.float64]  # (W,)
    skip: NDArray[np.uint8]  # (C,) HOLDS, and cells (diagonals as one) to one unlike it
    kind: NDArray[np.uint16]  # (C,)
    heights_m: NDArray[np.float32]  # (K, 3) solid top, span bottom, span top
    surface: NDArray[np.uint16]  # (K, 5) of solid side, solid cap, span, floor, ceiling
    texture: NDArray[np.int64]  # (S,) first texel
    placement: NDArray[np.float32]  # (S, 6) origin x, y, z; repeats a metre u, v; log2 texels/m
    light: NDArray[np.float32]  # (S * 6 * 3,) RGB factors of each face: tint times its shade
    texels: NDArray[np.uint8]  # (T * TEXELS * 3,), see `pyramid`

    @classmethod
    def pack(cls, worlds: Sequence[World]) -> "WorldBatch":
        """Flatten `worlds`; those whose `textures` are one array share its pyramid.

        Raises WorldError for an empty sequence or a surface index without a surface.
        """
        if not worlds:
            raise WorldError("a batch needs at least one world; found none")
        banks: dict[int, NDArray[np.uint8]] = {id(w.textures): w.textures for w in worlds}
        sizes = [bank.shape[0] * TEXELS for bank in banks.values()]
        first_texel = dict(zip(banks, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
        pyramids = [_cached_pyramid(bank) for bank in banks.values()]
        cells = [_pack_cells(world) for world in worlds]
        shapes = np.array([world.solid_top_m.shape for world in worlds], np.int64)
        counts = [len(world.surfaces.texture) for world in worlds]
        texture = [
            world.surfaces.texture.astype(np.int64) * TEXELS + first_texel[id(world.textures)]
            for world in worlds
        ]
        return cls(
            first_cell=np.cumsum([0, *(len(part[0]) for part in cells[:-1])]).astype(np.int64),
            first_kind=np.cumsum([0, *(len(part[2]) for part in cells[:-1])]).astype(np.int64),
            first_surface=np.cumsum([0, *counts[:-1]]).astype(np.int64),
            shape=shapes,
            origin_m=np.array([world.origin_m for world in worlds], np.float64),
            resolution_m=np.array([world.resolution_m for world in worlds], np.float64),
            ceiling_m=np.array([world.ceiling_m for world in worlds], np.float64),
            skip=np.concatenate([part[0] for part in cells]),
            kind=np.concatenate([part[1] for part in cells]),
            heights_m=np.concatenate([part[2] for part in cells]),
            surface=np.concatenate([part[3] for part in cells]),
            texture=np.concatenate(texture),
            placement=np.concatenate([_pack_placement(world) for world in worlds]),
            light=np.concatenate([_pack_light(world) for world in worlds]),
            texels=pyramids[0] if len(pyramids) == 1 else np.concatenate(pyramids),
        )

    def check(self, world_index: NDArray[np.integer], pose: NDArray[np.floating]) -> None:
        """Refuse indices and poses that the march cannot read safely."""
        if pose.shape != (*world_index.shape, 3) or world_index.ndim != 1:
            raise WorldError(
                f"expected world_index (B,) and pose (B, 3); found {world_index.shape} and "
                f"{pose.shape}"
            )
        worlds = len(self.first_cell)
        if world_index.size and not 0 <= world_index.min() <= world_index.max() < worlds:
            raise WorldError(
                f"world_index spans {world_index.min()}..{world_index.max()}; "
                f"this batch holds worlds 0..{worlds - 1}"
            )
        if not np.isfinite(pose).all():
            raise WorldError("a pose holds NaN or infinity; expected finite x, y, yaw")


def pyramid(textures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mip-maps of (N, 128, 128, 3) textures as (N * TEXELS * 3,).

    Each texture's levels follow one another, largest first, each box-filtered from the one
    before. A level is stored column by column, since a wall is painted down a column.
    """
    if textures.ndim != 4 or textures.shape[1:] != (TEXTURE_SIZE, TEXTURE_SIZE, 3):
        raise WorldError(
            f"textures have shape {textures.shape}; expected (N, {TEXTURE_SIZE}, {TEXTURE_SIZE}, 3)"
        )
    count = len(textures)
    level = np.ascontiguousarray(textures.transpose(0, 2, 1, 3))
    levels = [level]
    exact = level.astype(np.float32)
    for _ in range(LEVELS - 1):
        half = exact.shape[1] // 2
        exact = exact.reshape(count, half, 2, half, 2, 3).mean(axis=(2, 4))  # (N, n/2, n/2, 3)
        levels.append(np.rint(exact).astype(np.uint8))
    flat = [level.reshape(count, -1, 3) for level in levels]  # (N, n * n, 3)
    return np.concatenate(flat, axis=1).ravel()


def _cached_pyramid(textures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reuse the pyramid of a texture bank that is still alive: packing happens often."""
    key = id(textures)
    known = _pyramids.get(key)
    if known is not None and known[0]() is textures:
        return known[1]
    built = pyramid(textures)
    _pyramids[key] = (weakref.ref(textures, lambda _: _pyramids.pop(key, None)), built)
    return built


def _pack_cells(
    world: World,
) -> tuple[NDArray[np.uint8], NDArray[np.uint16], NDArray[np.float32], NDArray[np.uint16]]:
    """Return one world's `skip` (C,), `kind` (C,), `heights_m` (K, 3) and `surface` (K, 5)."""
    ceiling = np.float32(world.ceiling_m)
    solid = np.clip(world.solid_top_m, 0.0, ceiling)
    span_bottom = np.maximum(world.span_bottom_m, solid)
    span_top = np.minimum(world.span_top_m, ceiling)
    span_top = np.where(span_top > span_bottom, span_top, 0.0)
    heights = np.stack([solid, span_bottom, span_top], axis=-1).astype(np.float32)
    surfaces = (
        world.solid_side, world.solid_cap, world.span_surface, world.floor_surface,
        world.ceiling_surface,
    )  # fmt: skip
    surface = np.stack(surfaces, axis=-1).astype(np.uint16)
    highest = surface.max(initial=0)
    known, used = len(world.surfaces.texture), world.surfaces.texture
    if highest >= known:
        raise WorldError(f"world {world.name!r} uses surface {highest}; its table has {known}")
    if not 0 <= used.min() <= used.max() < len(world.textures):
        raise WorldError(
            f"world {world.name!r} uses textures {used.min()}..{used.max()}; "
            f"its bank has {len(world.textures)}"
        )
    holds = (solid > 0.0) | (span_top > 0.0)
    # What a ray inside a cell can meet; where it is alike all round, one step crosses it all.
    inside = np.concatenate([heights, surface[..., 1:3]], axis=-1)
    skip = _reach(np.where(holds[..., None], inside, 0.0)) | np.where(holds, HOLDS, 0)
    heights, surface = heights.reshape(-1, 3), surface.reshape(-1, 5)
    example, kind = _kinds(np.concatenate([heights.view(np.uint16), surface], axis=-1))
    if len(example) > KINDS:
        raise WorldError(
            f"world {world.name!r} has {len(example)} kinds of cells (heights and surfaces); "
            f"expected at most {KINDS}: round its heights"
        )
    grid = kind.astype(np.uint16).reshape(skip.shape)
    return _in_blocks(skip.astype(np.uint8)), _in_blocks(grid), heights[example], surface[example]


def _in_blocks(grid: NDArray[Any]) -> NDArray[Any]:
    """Lay a grid out block by block: what a ray passes in any direction lies close together."""
    rows, columns = grid.shape
    grid = np.pad(grid, ((0, -rows % BLOCK), (0, -columns % BLOCK)))
    blocks = grid.reshape(-(-rows // BLOCK), BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
    return blocks.ravel()


def _kinds(rows: NDArray[np.uint16]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Of rows (C, n), where each different one first stands (K,), and which each is (C,).

    As numpy.unique along an axis, and several times faster: four columns at a time.
    """
    example, kind = np.zeros(1, np.intp), np.zeros(len(rows), np.intp)
    words = np.pad(rows, ((0, 0), (0, -rows.shape[1] % 4)))
    for word in words.view(np.uint64).T:
        values, value = np.unique(word, return_inverse=True)
        _, example, kind = np.unique(
            kind * len(values) + value, return_index=True, return_inverse=True
        )
    return example, kind


def _reach(content: NDArray[np.floating]) -> NDArray[np.int64]:
    """Chessboard distance (rows, columns) to the nearest cell of other `content` (..., K)."""
    across = (content[:, 1:] == content[:, :-1]).all(axis=-1)
    down = (content[1:] == content[:-1]).all(axis=-1)
    alike = np.zeros(content.shape[:2], np.bool_)  # what lies beyond the edge is unlike
    level = across[:, 1:] & across[:, :-1]  # as left and right
    alike[1:-1, 1:-1] = level[:-2] & level[1:-1] & level[2:] & (down[:-1] & down[1:])[:, 1:-1]
    distance: NDArray[np.int64] = ndimage.distance_transform_cdt(alike, metric="chessboard")
    return np.minimum(distance + 1, REACH)


def _pack_light(world: World) -> NDArray[np.float32]:
    """Return (S * 6 * 3,): what a texel's RGB is multiplied by on each face of each surface."""
    tint = world.surfaces.tint.astype(np.float64)  # (S, 3)
    light: NDArray[np.float64] = tint[:, None] * np.array(SHADES)[:, None]  # (S, 6, 3)
    return light.astype(np.float32).ravel()


def _pack_placement(world: World) -> NDArray[np.float32]:
    """Return (S, 6): origin, repeats per metre along u and v, log2 of texels per metre."""
    repeats = 1.0 / world.surfaces.size_m
    density = np.log2(TEXTURE_SIZE * np.sqrt(repeats[:, 0] * repeats[:, 1]))
    columns = [world.surfaces.origin_m, repeats, density[:, None]]
    return np.concatenate(columns, axis=1).astype(np.float32)
