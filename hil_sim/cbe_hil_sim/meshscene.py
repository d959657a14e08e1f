"""Mesh scenes: a folder of OBJ + MTL files (z up, metres), its floor and free space found."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pybullet
from numpy.typing import NDArray
from scipy import ndimage

from cbe.errors import WorldError
from cbe_hil_sim.scene import Patch, Scene, solidify
from cbe_hil_sim.wavefront import Triangles, read_obj
from cbe_hil_sim.world import BLOCKING_HEIGHT_M, RESOLUTION_M, Surfaces, World

STEP_M = 0.055  # seams and rugs up to here are driven over
PASSABLE_M = 0.15  # free areas joined by narrower gaps count as apart
SAMPLE_M = 0.02  # between points on a triangle, so that no cell is missed
MAX_EXTENT_M = 200.0
AMBIENT = 0.8  # the rest of the light falls from above, so that corners show on plain walls
_RAYS = 16_000  # a batch; pybullet takes 16,384


def load_scene(folder: Path) -> Scene:
    """Load every OBJ of a folder; `collision.obj`, if there, is what body and scan meet.

    Raises WorldError if the folder or a file is unusable, or no floor is found.
    """
    if not folder.is_dir():
        raise WorldError(f"no scene folder {folder}; give a folder of OBJ files")
    collision = folder / "collision.obj"
    files = sorted(path for path in folder.glob("*.obj") if path != collision)
    if not files:
        raise WorldError(f"{folder} holds no visual OBJ file; expected a folder of OBJ + MTL files")
    visible = [triangles for path in files for triangles in read_obj(path)]
    hard = read_obj(collision) if collision.is_file() else visible
    if not visible or not hard:
        raise WorldError(f"{folder} holds no triangle; export the mesh with faces")
    solid = np.concatenate([triangles.corners for triangles in hard])
    extent = np.ptp(solid.reshape(-1, 3), axis=0)  # (T * 3, 3)
    if extent.max() > MAX_EXTENT_M:
        raise WorldError(
            f"{folder} extends {extent.max():.0f} m; at most {MAX_EXTENT_M:.0f} m: is it in metres?"
        )
    floor_m = _find_floor(solid)
    solid[..., 2] -= floor_m
    patches = _patches(visible, floor_m)
    planning = _planning(folder.name, solid)
    # Wheels roll on a plane, and what they drive over must not stop the body.
    return Scene(
        folder.name, patches, solid[solid[..., 2].max(axis=1) > STEP_M], planning,
        double_sided=True, ambient=AMBIENT,
    )  # fmt: skip


def _patches(visible: list[Triangles], floor_m: float) -> list[Patch]:
    """One patch a material."""
    by_material: dict[object, list[Triangles]] = {}
    for triangles in visible:
        by_material.setdefault(triangles.material, []).append(triangles)
    patches = []
    for parts in by_material.values():
        corners = np.concatenate([part.corners for part in parts])
        corners[..., 2] -= floor_m
        patches.append(
            Patch(corners, np.concatenate([part.uv for part in parts]), parts[0].material.image())
        )
    return patches


def _find_floor(solid_m: NDArray[np.float32]) -> float:
    """Height of the floor: the largest level area in the lowest metre."""
    cross = np.cross(solid_m[:, 1] - solid_m[:, 0], solid_m[:, 2] - solid_m[:, 0])
    area = np.linalg.norm(cross, axis=-1)
    level = np.abs(cross[:, 2]) > 0.95 * area
    height = solid_m[..., 2].mean(axis=1)
    level &= height < solid_m[..., 2].min() + 1.0
    if not level.any():
        raise WorldError("the scene has no level floor in its lowest metre; is z up, in metres?")
    bins = np.round(height[level] / 0.02).astype(np.int64)
    areas = np.bincount(bins - bins.min(), weights=area[level])
    # The upper side of a slab counts, even where the lower is a little larger.
    best = int(np.flatnonzero(areas > 0.5 * areas.max())[-1]) + bins.min()
    near = np.abs(bins - best) <= 1
    return float(np.average(height[level][near], weights=area[level][near]))


def _planning(name: str, solid_m: NDArray[np.float32]) -> World:
    """A 2.5-D world whose free cells are those that the robot can stand in."""
    low = solid_m[..., :2].min(axis=(0, 1)).astype(np.float64) - RESOLUTION_M
    size = np.ptp(solid_m[..., :2], axis=(0, 1)) + 2.0 * RESOLUTION_M
    columns, rows = np.ceil(size / RESOLUTION_M).astype(int)
    blocked = np.zeros((rows, columns), np.bool_)
    for points in _samples(solid_m):
        hit = (points[:, 2] > STEP_M) & (points[:, 2] < BLOCKING_HEIGHT_M)
        column, row = ((points[hit, :2] - low) / RESOLUTION_M).astype(int).T
        blocked[row, column] = True
    blocked |= ~_grounded(solid_m, low, ~blocked)
    blocked = ~_largest_area(~blocked)
    blank = np.zeros((rows, columns), np.uint16)
    none = np.zeros((rows, columns), np.float32)
    ceiling_m = max(float(solid_m[..., 2].max()), 2.0)
    surfaces = Surfaces(
        np.zeros(1, np.int32), np.zeros((1, 3), np.float32), np.ones((1, 2), np.float32),
        np.ones((1, 3), np.float32),
    )  # fmt: skip
    textures = np.full((1, 128, 128, 3), 160, np.uint8)
    return World(
        solid_top_m=blocked * np.float32(BLOCKING_HEIGHT_M), span_bottom_m=none, span_top_m=none,
        solid_side=blank, solid_cap=blank, span_surface=blank, floor_surface=blank,
        ceiling_surface=blank, ceiling_m=ceiling_m, surfaces=surfaces, textures=textures,
        origin_m=(float(low[0]), float(low[1])), name=name,
    )  # fmt: skip


def _samples(solid_m: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
    """Points (N, 3) on the triangles at the robot's height, at most `SAMPLE_M` apart."""
    height = solid_m[..., 2]
    near = (height.max(axis=1) > STEP_M) & (height.min(axis=1) < BLOCKING_HEIGHT_M)
    corners = solid_m[near]
    edge = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)  # (T, 3)
    # From the corner opposite to the longest edge, slivers need the fewest points.
    first = (edge.argmax(axis=1) + 2) % 3
    rows = np.arange(len(corners))
    apex = corners[rows, first]
    one = corners[rows, (first + 1) % 3] - apex
    two = corners[rows, (first + 2) % 3] - apex
    counts = np.stack([np.linalg.norm(side, axis=-1) for side in (one, two)], axis=-1) / SAMPLE_M
    powers = np.ceil(np.log2(np.maximum(counts, 1.0))).astype(int)  # few shapes of lattices
    for power in np.unique(powers, axis=0):
        chosen = np.flatnonzero((powers == power).all(axis=1))
        u, v = np.meshgrid(*(np.linspace(0.0, 1.0, 2**n + 1, dtype=np.float32) for n in power))
        inside = u + v <= 1.0 + 1e-6
        u, v = u[inside], v[inside]  # (K,)
        for part in np.array_split(chosen, -(-len(chosen) * len(u) // 2_000_000)):
            points = u[:, None] * one[part, None] + v[:, None] * two[part, None]
            yield (points + apex[part, None]).reshape(-1, 3)  # (N * K, 3)


def _grounded(
    solid_m: NDArray[np.float32], low_m: NDArray[np.float64], asked: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Cells (rows, columns) of those asked under whose middle a ray from above meets the floor."""
    row, column = np.nonzero(asked)
    middle = low_m + (np.stack([column, row], axis=-1) + 0.5) * RESOLUTION_M  # (N, 2)
    grounded = np.zeros_like(asked)
    client = pybullet.connect(pybullet.DIRECT)
    try:
        solidify(solid_m, client)
        for first in range(0, len(middle), _RAYS):
            xy = middle[first : first + _RAYS]
            start = np.column_stack([xy, np.full(len(xy), BLOCKING_HEIGHT_M)]).tolist()
            end = np.column_stack([xy, np.full(len(xy), -STEP_M)]).tolist()
            hits = pybullet.rayTestBatch(start, end, physicsClientId=client)
            found = np.array([hit[0] >= 0 and hit[3][2] <= STEP_M for hit in hits])
            grounded[row[first : first + _RAYS], column[first : first + _RAYS]] = found
    finally:
        pybullet.disconnect(client)
    # A seam between floor tiles is no hole.
    return np.asarray(ndimage.binary_closing(np.pad(grounded, 2), np.ones((3, 3)))[2:-2, 2:-2])


def _largest_area(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Part of the free cells that one robot can reach from most places."""
    clearance = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * RESOLUTION_M
    labels, count = ndimage.label(clearance > PASSABLE_M)
    if count == 0:
        raise WorldError("the scene has no free floor for the robot; is z up, in metres?")
    largest = labels == 1 + np.bincount(labels.ravel())[1:].argmax()
    reach = ndimage.distance_transform_edt(~largest) * RESOLUTION_M
    return np.asarray(free & (reach <= PASSABLE_M))
