"""Compiled front-to-back march over the cells of a world: images and scans.

One file, because numba's cache does not notice a change in another file; the constants
imported here are compiled in, so delete __pycache__ after changing those. An index made
unsigned tells numba that it is not counted from the end.

Each image column is marched front to back: painting notes the texel that a ray meets and the
light on it, and what no nearer face has painted is open. Colours are read only then.
"""

import math
from typing import Any

import numba
import numpy as np

from cbe_hil_sim.world import (
    DOWN,
    NEGATIVE_X,
    NEGATIVE_Y,
    POSITIVE_X,
    POSITIVE_Y,
    SHADES,
    UP,
)
from cbe_hil_sim.worldbatch import BLOCK, BLOCK_BITS, HOLDS, LEVELS, REACH, TEXTURE_SIZE

NEAR_M = 1e-4  # depth of the face seen by a camera that stands inside a solid
FAR = 1e5  # keeps what a level row would hit finite
LEVEL_START = np.array([(4**LEVELS - 4 ** (LEVELS - n)) // 3 for n in range(LEVELS)], np.int64)
FACES = len(SHADES)
SIDE, CAP, SPAN, FLOOR, CEILING = range(5)  # columns of WorldBatch.surface
ALONG_X, ALONG_Y = 0, 1  # normal of a vertical face


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _cell(first_cell: int, columns: int, row: int, column: int) -> Any:
    """Index of a cell in its batch; grids are stored in blocks, row by row of each."""
    blocks = (columns + BLOCK - 1) >> BLOCK_BITS  # side by side
    block = (row >> BLOCK_BITS) * blocks + (column >> BLOCK_BITS)
    within = ((row & (BLOCK - 1)) << BLOCK_BITS) + (column & (BLOCK - 1))
    return np.uint64(first_cell + (block << (2 * BLOCK_BITS)) + within)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _advance(
    x: float, y: float, dx: float, dy: float, per_dx: float, per_dy: float,
    column: int, row: int, reach: Any,
) -> tuple[int, int, float, int]:  # fmt: skip
    """Leave the box of `reach` - 1 cells round a cell: next column, row, ray length, normal.

    Position and direction are in cells, `per_dx` and `per_dy` are the direction's reciprocals
    (+inf for 0); the ray length is in units of the direction.
    """
    to_x = ((column + reach if dx >= 0.0 else column + 1 - reach) - x) * per_dx
    to_y = ((row + reach if dy >= 0.0 else row + 1 - reach) - y) * per_dy
    if to_x < to_y:
        across = math.floor(y + to_x * dy)
        row = min(max(across, row + 1 - reach), row + reach - 1)  # against rounding
        return column + (reach if dx >= 0.0 else -reach), row, to_x, ALONG_X
    across = math.floor(x + to_y * dx)
    column = min(max(across, column + 1 - reach), column + reach - 1)
    return column, row + (reach if dy >= 0.0 else -reach), to_y, ALONG_Y


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _paint_side(
    batch: Any, surface: int, normal: int, face: int, u_at: float, v_at: float,
    v_step: float, footprint: float, first: int, last: int, texel: Any, light: Any,
) -> None:  # fmt: skip
    """Paint the open sub-rows first..last of a vertical face; sub-row 0 is at `v_at` (m)."""
    placement = batch.placement[surface]
    level = min(max(int(footprint + placement[5] + 0.5), 0), LEVELS - 1)
    size = TEXTURE_SIZE >> level
    mask = size - 1
    u = (u_at - placement[1 if normal == ALONG_X else 0]) * placement[3]
    start = batch.texture[surface] + LEVEL_START[level] + (math.floor(u * size) & mask) * size
    v_scale = placement[4] * size
    v = (v_at - placement[2]) * v_scale
    v_step *= v_scale
    lit = FACES * surface + face
    for sub_row in range(first, last + 1):
        at = np.uint64(sub_row)
        if texel[at] < 0:
            texel[at] = start + (~math.floor(v + sub_row * v_step) & mask)
            light[at] = lit


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _paint_plane(
    batch: Any, surface: int, face: int, x_m: float, y_m: float, dx_m: float, dy_m: float,
    rise_m: float, depth_per_rise: Any, footprint: Any, first: int, last: int,
    texel: Any, light: Any,
) -> None:  # fmt: skip
    """Paint the open sub-rows first..last of a horizontal plane `rise_m` above the camera."""
    placement = batch.placement[surface]
    u = (x_m - placement[0]) * placement[3]
    v = (y_m - placement[1]) * placement[4]
    du = rise_m * dx_m * placement[3]
    dv = rise_m * dy_m * placement[4]
    detail = math.log2(max(abs(rise_m), NEAR_M)) + placement[5] + 0.5
    start = batch.texture[surface]
    lit = FACES * surface + face
    for sub_row in range(first, last + 1):
        at = np.uint64(sub_row)
        if texel[at] < 0:
            level = np.uint64(min(max(int(footprint[at] + detail), 0), LEVELS - 1))
            size = TEXTURE_SIZE >> np.int64(level)
            depth = depth_per_rise[at]
            across = math.floor((u + depth * du) * size) & (size - 1)
            down = ~math.floor((v + depth * dv) * size) & (size - 1)
            texel[at] = start + LEVEL_START[level] + across * size + down
            light[at] = lit


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint_open(
    batch: Any, world: int, x: float, y: float, dx: float, dy: float, camera_x_m: float,
    camera_y_m: float, camera_z_m: float, dx_m: float, dy_m: float, middle: float,
    depth_per_rise: Any, footprint: Any, texel: Any, light: Any,
) -> None:  # fmt: skip
    """Paint the floor and the ceiling where the column is still open."""
    rows, columns = batch.shape[world]
    first_cell, first_kind = batch.first_cell[world], batch.first_kind[world]
    first_surface = batch.first_surface[world]
    sub_rows = len(texel)
    horizon = min(max(math.ceil(middle), 0), sub_rows)
    for plane in (FLOOR, CEILING):
        rise, face, first, end = -camera_z_m, UP, horizon, sub_rows
        if plane == CEILING:
            rise, face, first, end = batch.ceiling_m[world] - camera_z_m, DOWN, 0, horizon
        log2_rise = math.log2(max(abs(rise), NEAR_M))
        known = -1
        surface = lit = start = size = 0
        u = v = du = dv = detail = finer = coarser = 0.0
        for sub_row in range(first, end):
            at = np.uint64(sub_row)
            if texel[at] >= 0:
                continue
            depth = rise * depth_per_rise[at]
            column = min(max(math.floor(x + depth * dx), 0), columns - 1)
            row = min(max(math.floor(y + depth * dy), 0), rows - 1)
            kind = int(batch.kind[_cell(first_cell, columns, row, column)])
            extent = footprint[at]
            if kind != known or not finer <= extent < coarser:
                known, surface = kind, first_surface + batch.surface[first_kind + kind, plane]
                placement = batch.placement[surface]
                detail = log2_rise + placement[5] + 0.5
                level = min(max(int(extent + detail), 0), LEVELS - 1)
                finer = level - detail if level > 0 else -np.inf
                coarser = level + 1 - detail if level < LEVELS - 1 else np.inf
                size = int(TEXTURE_SIZE) >> level
                u = (camera_x_m - placement[0]) * placement[3] * size
                v = (camera_y_m - placement[1]) * placement[4] * size
                du = dx_m * placement[3] * size
                dv = dy_m * placement[4] * size
                start = batch.texture[surface] + LEVEL_START[level]
                lit = FACES * surface + face
            across = math.floor(u + depth * du) & (size - 1)
            down = ~math.floor(v + depth * dv) & (size - 1)
            texel[at] = start + across * size + down
            light[at] = lit


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _colour(
    supersample: int, texels: Any, lights: Any, texel: Any, light: Any, pixels: Any
) -> None:
    """Fill a column of pixels (h, 3) with the mean of what its rays (n, h * n) meet."""
    scale, half, white = np.float32(1.0 / supersample**2), np.float32(0.5), np.float32(255.0)
    one, two, sub_row = np.uint64(1), np.uint64(2), np.uint64(0)
    for pixel_row in range(len(pixels)):
        red = green = blue = np.float32(0.0)
        for _ in range(supersample):
            for column in range(supersample):
                sub_column = np.uint64(column)
                at = np.uint64(3 * np.int64(texel[sub_column, sub_row]))
                lit = np.uint64(3 * np.int64(light[sub_column, sub_row]))
                red += min(texels[at] * lights[lit], white)
                green += min(texels[at + one] * lights[lit + one], white)
                blue += min(texels[at + two] * lights[lit + two], white)
            sub_row += one
        pixels[pixel_row, 0] = np.uint8(red * scale + half)
        pixels[pixel_row, 1] = np.uint8(green * scale + half)
        pixels[pixel_row, 2] = np.uint8(blue * scale + half)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _render_image(
    batch: Any, world: int, camera_x_m: float, camera_y_m: float, yaw: float, camera_z_m: float,
    fx: float, fy: float, cx: float, cy: float, supersample: int, image: Any,
) -> None:  # fmt: skip
    """Render one view; intrinsics are those of the super-sampled image."""
    rows, columns = batch.shape[world]
    first_cell, first_kind = batch.first_cell[world], batch.first_kind[world]
    first_surface = batch.first_surface[world]
    cell_m, ceiling_m = batch.resolution_m[world], batch.ceiling_m[world]
    x = (camera_x_m - batch.origin_m[world, 0]) / cell_m
    y = (camera_y_m - batch.origin_m[world, 1]) / cell_m
    cos, sin = math.cos(yaw), math.sin(yaw)
    sub_rows = image.shape[0] * supersample
    middle = cy - 0.5  # sub-row of the horizon
    log2_focal = 0.5 * math.log2(fx * fy)
    # Of a horizontal plane: depth per metre above the camera, and log2 of a sub-row's extent
    # (mean of along and across) but for the plane's own log2 height.
    depth_per_rise = np.empty(sub_rows)
    footprint = np.empty(sub_rows)
    for sub_row in range(sub_rows):
        slope = (middle - sub_row) / fy
        depth_per_rise[sub_row] = 1.0 / slope if abs(slope) > 1.0 / FAR else FAR
        footprint[sub_row] = 1.5 * math.log2(abs(depth_per_rise[sub_row])) - log2_focal
    texels = np.empty((supersample, sub_rows), np.int32)  # met by each ray; -1: open
    lights = np.empty((supersample, sub_rows), np.int32)

    for sub_column in range(image.shape[1] * supersample):
        texel, light = texels[sub_column % supersample], lights[sub_column % supersample]
        texel[:] = -1
        left = (cx - (sub_column + 0.5)) / fx
        dx_m, dy_m = cos - sin * left, sin + cos * left
        dx, dy = dx_m / cell_m, dy_m / cell_m
        per_dx = 1.0 / dx if dx != 0.0 else np.inf
        per_dy = 1.0 / dy if dy != 0.0 else np.inf
        face_x = NEGATIVE_X if dx > 0.0 else POSITIVE_X
        face_y = NEGATIVE_Y if dy > 0.0 else POSITIVE_Y
        column, row = math.floor(x), math.floor(y)
        inside = 0 <= column < columns and 0 <= row < rows
        nearest_row, nearest_column = min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)
        cell = _cell(first_cell, columns, nearest_row, nearest_column)
        near, normal = NEAR_M, ALONG_X
        top, bottom = 0, sub_rows - 1  # sub-rows that may still be open
        solid_before = span_bottom_before = span_top_before = 0.0
        while True:
            next_column, next_row, far, next_normal = column, row, near, normal
            solid, span_bottom, span_top = ceiling_m, 0.0, 0.0
            if inside:
                next_column, next_row, far, next_normal = _advance(
                    x, y, dx, dy, per_dx, per_dy, column, row, np.int64(batch.skip[cell] & REACH)
                )
                if batch.skip[cell] & HOLDS == 0:
                    column, row, near, normal = next_column, next_row, far, next_normal
                    inside = 0 <= column < columns and 0 <= row < rows
                    if inside:
                        cell = _cell(first_cell, columns, row, column)
                    solid_before = span_bottom_before = span_top_before = 0.0
                    continue
                heights = batch.heights_m[first_kind + batch.kind[cell]]
                solid, span_bottom, span_top = heights[0], heights[1], heights[2]
            kind = first_kind + batch.kind[cell]
            near = max(near, NEAR_M)
            far = max(far, near)
            per_m = fy / near  # sub-rows per metre of height at the near edge
            top = max(top, math.ceil(middle - (ceiling_m - camera_z_m) * per_m))
            bottom = min(bottom, math.floor(middle + camera_z_m * per_m))

            side, along_m = face_x, camera_y_m + near * dy_m
            slant = max(abs(dx_m), 1e-3)  # at a slant, one column covers more of a wall
            if normal == ALONG_Y:
                side, along_m, slant = face_y, camera_x_m + near * dx_m, max(abs(dy_m), 1e-3)
            if solid > solid_before:
                first = max(top, math.ceil(middle - (solid - camera_z_m) * per_m))
                last = min(bottom, math.floor(middle - (solid_before - camera_z_m) * per_m))
                if first <= last:
                    _paint_side(
                        batch, first_surface + batch.surface[kind, SIDE], normal, side, along_m,
                        camera_z_m + middle / per_m, -1.0 / per_m,
                        0.5 * math.log2(near * near / slant) - log2_focal, first, last,
                        texel, light,
                    )  # fmt: skip
            if solid >= ceiling_m:
                break
            new_span = span_bottom < span_bottom_before or span_top > span_top_before
            if span_top > 0.0 and new_span:
                first = max(top, math.ceil(middle - (span_top - camera_z_m) * per_m))
                last = min(bottom, math.floor(middle - (span_bottom - camera_z_m) * per_m))
                if first <= last:
                    _paint_side(
                        batch, first_surface + batch.surface[kind, SPAN], normal, side, along_m,
                        camera_z_m + middle / per_m, -1.0 / per_m,
                        0.5 * math.log2(near * near / slant) - log2_focal, first, last,
                        texel, light,
                    )  # fmt: skip

            for face in range(3):  # nearest first: span's top, span's underside, solid's cap
                height_m, surface, side = span_top, SPAN, UP
                if face == 1:
                    height_m, side = span_bottom, DOWN
                elif face == 2:
                    height_m, surface = solid, CAP
                rise, under = height_m - camera_z_m, face == 1
                absent = span_top <= 0.0 if face < 2 else solid <= 0.0
                if absent or rise == 0.0 or under != (rise > 0.0):
                    continue
                at_near, at_far = middle - rise * per_m, middle - rise * fy / far
                first = max(top, math.ceil(at_near if under else at_far))
                last = min(bottom, math.floor(at_far if under else at_near))
                if first > last:
                    continue
                _paint_plane(
                    batch, first_surface + batch.surface[kind, surface], side, camera_x_m,
                    camera_y_m, dx_m, dy_m, rise, depth_per_rise, footprint, first, last,
                    texel, light,
                )  # fmt: skip

            while top <= bottom and texel[top] >= 0:
                top += 1
            while top <= bottom and texel[bottom] >= 0:
                bottom -= 1
            if top > bottom:
                break
            column, row, near, normal = next_column, next_row, far, next_normal
            solid_before, span_bottom_before, span_top_before = solid, span_bottom, span_top
            inside = 0 <= column < columns and 0 <= row < rows
            if inside:
                cell = _cell(first_cell, columns, row, column)

        _paint_open(
            batch, world, x, y, dx, dy, camera_x_m, camera_y_m, camera_z_m, dx_m, dy_m, middle,
            depth_per_rise, footprint, texel, light,
        )  # fmt: skip
        if (sub_column + 1) % supersample == 0:
            pixels = image[:, sub_column // supersample]
            if supersample == 2:  # a constant unrolls the loops
                _colour(2, batch.texels, batch.light, texels, lights, pixels)
            else:
                _colour(supersample, batch.texels, batch.light, texels, lights, pixels)


@numba.njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def render_images(
    batch: Any, world_index: Any, order: Any, camera_pose: Any, camera_z_m: Any, horizon_px: Any,
    fx: float, fy: float, cx: float, supersample: int, images: Any,
) -> None:  # fmt: skip
    """Fill images (B, h, w, 3), one after the other in `order`, from camera poses (B, 3).

    horizon_px (B,) is the row of level.
    """
    for k in numba.prange(len(images)):
        b = order[k]
        _render_image(
            batch, world_index[b], camera_pose[b, 0], camera_pose[b, 1], camera_pose[b, 2],
            camera_z_m[b], fx * supersample, fy * supersample, cx * supersample,
            horizon_px[b] * supersample, supersample, images[b],
        )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def scan_rays(
    batch: Any, world_index: Any, sensor_pose: Any, angles_rad: Any, height_m: float,
    range_m: float, scans_m: Any,
) -> None:  # fmt: skip
    """Fill scans (B, rays): distance to the first cell that holds something at `height_m`."""
    for b in numba.prange(len(scans_m)):
        world = world_index[b]
        rows, columns = batch.shape[world]
        first_cell, cell_m = batch.first_cell[world], batch.resolution_m[world]
        x = (sensor_pose[b, 0] - batch.origin_m[world, 0]) / cell_m
        y = (sensor_pose[b, 1] - batch.origin_m[world, 1]) / cell_m
        for ray in range(len(angles_rad)):
            angle = sensor_pose[b, 2] + angles_rad[ray]
            dx, dy = math.cos(angle) / cell_m, math.sin(angle) / cell_m
            per_dx = 1.0 / dx if dx != 0.0 else np.inf
            per_dy = 1.0 / dy if dy != 0.0 else np.inf
            column, row = math.floor(x), math.floor(y)
            distance = 0.0
            while distance <= range_m and 0 <= column < columns and 0 <= row < rows:
                cell = _cell(first_cell, columns, row, column)
                if batch.skip[cell] & HOLDS:
                    heights = batch.heights_m[batch.first_kind[world] + batch.kind[cell]]
                    if heights[0] >= height_m or heights[1] <= height_m <= heights[2]:
                        break
                column, row, distance, _ = _advance(
                    x, y, dx, dy, per_dx, per_dy, column, row, np.int64(batch.skip[cell] & REACH)
                )
            scans_m[b, ray] = max(distance, 0.0) if distance <= range_m else np.inf
