"""Worlds from floor plans: occupancy images (as ROS map_server's PGM + YAML) and polygons.

A plan says only where walls are, so surfaces and the heights of small things are drawn from a seed.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from cbe.errors import WorldError
from cbe_hil_sim.surfacing import SurfaceTable, draw_looks, pick
from cbe_hil_sim.textures import bank
from cbe_hil_sim.world import RESOLUTION_M, World

CEILING_M = 2.6
MARGIN = 4  # cells of wall round the plan
MOST_CELLS = 16_000_000
ROOM_CLEARANCE_M = 0.7  # narrower necks part the floor into rooms
FURNITURE_M2 = 2.5  # smaller islands are furniture, larger ones walls

Rng = np.random.Generator
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Where a plan is occupied: (rows, columns) with row 0 at the lowest y.

    `origin_m` is the world position of the lower left corner.
    """

    occupied: Mask
    resolution_m: float
    origin_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse plans without size, resolution or free space."""
        if self.occupied.ndim != 2 or self.occupied.size == 0:
            raise WorldError(f"floor plan has shape {self.occupied.shape}; expected rows, columns")
        if not 0.001 <= self.resolution_m <= 1.0:
            raise WorldError(
                f"floor plan resolution is {self.resolution_m} m a pixel; expected 0.001 to 1"
            )
        if self.occupied.all():
            raise WorldError("floor plan has no free space; free pixels are the bright ones")
        scale = self.resolution_m / RESOLUTION_M
        if self.occupied.size * scale**2 > MOST_CELLS:
            raise WorldError(
                f"floor plan of {self.occupied.shape} pixels at {self.resolution_m} m is too "
                f"large; crop it to {MOST_CELLS * RESOLUTION_M**2:.0f} m2"
            )


def from_image(
    image: NDArray[np.uint8],
    resolution_m: float,
    *,
    origin_m: tuple[float, float] = (0.0, 0.0),
    free_threshold: float = 0.196,
    negate: bool = False,
) -> FloorPlan:
    """Read an occupancy image (rows, columns) uint8, row 0 at the top, dark where occupied.

    A pixel is free where its occupancy, (255 - value) / 255, is below `free_threshold`; unknown
    pixels count as occupied.

    Raises:
        WorldError: the image or a parameter is unusable.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise WorldError(
            f"occupancy image is {image.dtype} of shape {image.shape}; "
            "expected one grey channel of uint8"
        )
    if not 0.0 < free_threshold <= 1.0:
        raise WorldError(f"free threshold is {free_threshold}; expected above 0, up to 1")
    value = image.astype(np.float64) / 255.0
    occupancy = value if negate else 1.0 - value
    return FloorPlan(occupancy[::-1] >= free_threshold, resolution_m, origin_m)


def read_map(path: Path) -> FloorPlan:
    """Read a ROS map_server map: a YAML file that names its image.

    Raises:
        WorldError: a file is missing or damaged, or a key is missing or has a bad value.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise WorldError(f"cannot read map file {path}: {error}") from error
    entries = {}
    for line in lines:
        key, colon, value = line.split("#")[0].partition(":")
        if colon:
            entries[key.strip()] = value.strip().strip("'\"")
    if "image" not in entries:
        raise WorldError(f"map file {path} names no image; expected a line 'image: <file>'")
    x, y, yaw = _numbers(entries, "origin", path, 3)
    if yaw != 0.0:
        raise WorldError(f"map file {path} is turned by {yaw} rad; only maps with yaw 0 are read")
    picture = path.parent / entries["image"]
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE) if picture.is_file() else None
    if image is None:
        raise WorldError(f"map file {path} names image {picture}, which is missing or damaged")
    return from_image(
        np.asarray(image, np.uint8),
        _numbers(entries, "resolution", path, 1)[0],
        origin_m=(x, y),
        free_threshold=_numbers(entries, "free_thresh", path, 1, 0.196)[0],
        negate=_numbers(entries, "negate", path, 1, 0.0)[0] != 0.0,
    )


def _numbers(
    entries: dict[str, str], key: str, path: Path, count: int, default: float | None = None
) -> list[float]:
    """Return the `count` finite numbers of an entry."""
    if key not in entries and default is not None:
        return [default]
    found = entries.get(key, "nothing")
    try:
        parsed = json.loads(found)
        numbers = [float(v) for v in (parsed if isinstance(parsed, list) else [parsed])]
    except (ValueError, TypeError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise WorldError(f"map file {path} has {key}: {found}; expected {count} number(s)")
    return numbers


def from_polygons(
    rooms: Sequence[NDArray[np.floating]], obstacles: Sequence[NDArray[np.floating]] = ()
) -> FloorPlan:
    """Free floor is the union of `rooms`, polygons (K, 2) in metres, less the `obstacles`.

    Rooms that are to be joined overlap or share a doorway's polygon.

    Raises:
        WorldError: no room, or a polygon with under three finite corners.
    """
    if not rooms:
        raise WorldError("floor plan has no room; expected at least one polygon of corners in m")
    for polygon in (*rooms, *obstacles):
        if polygon.ndim != 2 or polygon.shape[1] != 2 or len(polygon) < 3:
            raise WorldError(f"polygon has shape {polygon.shape}; expected (3 or more, 2)")
        if not np.isfinite(polygon).all():
            raise WorldError(f"polygon has a corner that is not finite: {polygon.tolist()}")
    corners = np.concatenate(rooms)
    low = np.floor(corners.min(axis=0) / RESOLUTION_M) * RESOLUTION_M
    columns, rows = np.ceil((corners.max(axis=0) - low) / RESOLUTION_M).astype(int)
    if rows * columns > MOST_CELLS:
        raise WorldError(f"floor plan spans {columns} x {rows} cells of 0.05 m; are units metres?")
    free = np.zeros((rows, columns), np.bool_)
    for polygon in rooms:
        free |= _inside(polygon, low, (rows, columns))
    for polygon in obstacles:
        free &= ~_inside(polygon, low, (rows, columns))
    return FloorPlan(~free, RESOLUTION_M, (float(low[0]), float(low[1])))


def _inside(
    polygon: NDArray[np.floating], low: NDArray[np.floating], shape: tuple[int, int]
) -> Mask:
    """Return the cells whose centres lie inside a polygon, by crossings of a ray along x."""
    x = low[0] + (np.arange(shape[1]) + 0.5) * RESOLUTION_M
    y = low[1] + (np.arange(shape[0]) + 0.5) * RESOLUTION_M
    inside = np.zeros(shape, np.bool_)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        rows = np.flatnonzero((y0 <= y) != (y1 <= y))
        crossing = x0 + (y[rows] - y0) * (x1 - x0) / (y1 - y0)
        inside[rows] ^= x[None, :] > crossing[:, None]
    return inside


def from_floorplan(plan: FloorPlan | Path, *, seed: int = 0, split: str = "train") -> World:
    """Build a closed world on a plan, or on the map file at a path, with seeded surfaces.

    Islands under `FURNITURE_M2` become furniture of a random height; all else is wall.

    Raises:
        WorldError: the plan cannot be read or has no free space.
    """
    if isinstance(plan, Path):
        name, plan = plan.stem, read_map(plan)
    else:
        name = "floorplan"
    occupied = np.pad(_resampled(plan), MARGIN, constant_values=True)
    rng = np.random.default_rng([seed, 11])
    room_of = _rooms(occupied)
    looks = draw_looks(rng, ["living"] * (int(room_of.max()) + 1), "house")
    table = SurfaceTable()
    floors, ceilings, walls = [], [], []
    for look in looks:
        offset = (float(rng.uniform(0, 5)), float(rng.uniform(0, 5)), 0.0)
        floors.append(table.add(look.floor, (look.floor_size_m, look.floor_size_m), look.tint))
        ceilings.append(table.add(look.ceiling, (2.4, 2.4), look.tint))
        walls.append(table.add(look.walls[0], (look.wall_width_m, CEILING_M), look.tint, offset))
    solid_top = np.where(occupied, np.float32(CEILING_M), np.float32(0.0))
    side = np.asarray(walls, np.uint16)[room_of]
    cap = side.copy()
    labels, count = ndimage.label(occupied, np.ones((3, 3)))
    areas_m2 = np.bincount(labels.ravel(), minlength=count + 1) * RESOLUTION_M**2
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None or areas_m2[label] > FURNITURE_M2 or box[0].start == 0:
            continue
        island = labels[box] == label
        height_m = float(rng.uniform(0.4, 1.9))
        tint = looks[int(room_of[box][island][0])].tint
        face = pick(rng, "cabinet", "bookshelf", "fabric", "box", "wood")
        solid_top[box][island] = height_m
        side[box][island] = table.add(face, (1.0, height_m), tint)
        cap[box][island] = table.add(pick(rng, "wood", "lacquer"), (1.0, 1.0), tint)
    nothing = np.zeros_like(solid_top)
    origin_m = tuple(o - MARGIN * RESOLUTION_M for o in plan.origin_m)
    return World(
        solid_top, nothing, nothing, side, cap, side, np.asarray(floors, np.uint16)[room_of],
        np.asarray(ceilings, np.uint16)[room_of], CEILING_M, table.finish(), bank(split),
        (origin_m[0], origin_m[1]), name=name,
    )  # fmt: skip


def _resampled(plan: FloorPlan) -> Mask:
    """Return the plan on cells of `RESOLUTION_M`; a cell is occupied if any pixel in it is."""
    pixel = plan.resolution_m / RESOLUTION_M
    grid = plan.occupied
    for axis in (0, 1):
        size = grid.shape[axis]
        cells = max(round(size * pixel), 1)
        edges = np.arange(cells) / pixel
        # Fine pixels are gathered cell by cell, coarse ones repeated.
        first = np.minimum(np.floor(edges + 1e-6).astype(np.intp), size - 1)
        if pixel < 1.0:
            grid = np.logical_or.reduceat(grid, np.unique(first), axis=axis)
        else:
            grid = np.take(grid, first, axis=axis)
    return grid


def _rooms(occupied: Mask) -> NDArray[np.intp]:
    """Give every cell, walls too, the number of the nearest room; necks part rooms."""
    clearance_m = ndimage.distance_transform_edt(~occupied) * RESOLUTION_M
    cores, count = ndimage.label(clearance_m > ROOM_CLEARANCE_M)
    if count == 0:
        return np.zeros(occupied.shape, np.intp)
    nearest = ndimage.distance_transform_edt(
        cores == 0, return_distances=False, return_indices=True
    )
    rooms: NDArray[np.intp] = cores[tuple(nearest)].astype(np.intp) - 1
    return rooms
