"""Puts furniture into rooms: free of doors and of each other, every room still reachable."""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from cbe_hil_sim import furniture
from cbe_hil_sim.furniture import Part, Piece
from cbe_hil_sim.layout import Layout, Opening, Rect, to_cells
from cbe_hil_sim.world import BLOCKING_HEIGHT_M, RESOLUTION_M

Rng = np.random.Generator

DOOR_ZONE = 20  # cells kept free before and behind a door
DOOR_ZONE_BESIDE = 8
WALKWAY = 13  # cells kept between free-standing pieces and all else
PASSABLE_CELLS = 6.5  # between cell centres: 0.3 m of `World.clearance_m`


@dataclass(frozen=True, slots=True)
class Footprint:
    """Cells that a part covers: where its mask lies in the grid."""

    part: Part
    where: tuple[slice, slice]
    mask: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Placed:
    """A piece at its place in a room."""

    room: int
    footprints: tuple[Footprint, ...]


def _rasterise(part: Part, x_m: float, y_m: float, angle: float) -> Footprint | None:
    """Cover the cells whose centres lie inside the part of a piece at (x, y, angle)."""
    cos, sin = math.cos(angle), math.sin(angle)
    px, py = x_m + cos * part.u_m - sin * part.v_m, y_m + sin * part.u_m + cos * part.v_m
    reach_x = 0.5 * (abs(cos) * part.width_m + abs(sin) * part.depth_m)
    reach_y = 0.5 * (abs(sin) * part.width_m + abs(cos) * part.depth_m)
    x0, x1 = (math.floor(v / RESOLUTION_M) for v in (px - reach_x, px + reach_x))
    y0, y1 = (math.floor(v / RESOLUTION_M) for v in (py - reach_y, py + reach_y))
    dx = (np.arange(x0, x1 + 1)[None, :] + 0.5) * RESOLUTION_M - px
    dy = (np.arange(y0, y1 + 1)[:, None] + 0.5) * RESOLUTION_M - py
    u = np.abs(cos * dx + sin * dy) / (0.5 * part.width_m)
    v = np.abs(cos * dy - sin * dx) / (0.5 * part.depth_m)
    mask = u * u + v * v <= 1.0 if part.round else np.maximum(u, v) <= 1.0 + 1e-6
    if not mask.any():
        return None
    return Footprint(part, (slice(y0, y1 + 1), slice(x0, x1 + 1)), mask)


@dataclass(slots=True)
class Placer:
    """Fills the rooms of one layout; `placed` is the result."""

    layout: Layout
    rng: Rng
    wall: NDArray[np.bool_] = field(init=False)
    kept_free: NDArray[np.bool_] = field(init=False)  # before doors
    used: NDArray[np.bool_] = field(init=False)  # by walls and pieces
    low_only: NDArray[np.bool_] = field(init=False)  # under windows
    placed: list[Placed] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        """Mark walls and the free zones of doors."""
        self.wall = np.ones(self.layout.shape, np.bool_)
        for room in self.layout.rooms:
            self.wall[room.rect.slices] = False
        self.kept_free = np.zeros_like(self.wall)
        for opening in self.layout.openings:
            self.wall[opening.rect.slices] = False
            self.kept_free[_zone(opening, DOOR_ZONE_BESIDE).slices] = True
        self.used = self.wall.copy()
        self.low_only = np.zeros_like(self.wall)

    def furnish(self) -> list[Placed]:
        """Place everything, then take away what cuts the floor into parts."""
        self._hang_door_leaves()
        for index in range(len(self.layout.rooms)):
            self._furnish_room(index)
        self._reconnect()
        return self.placed

    def _furnish_room(self, index: int) -> None:
        rng, room = self.rng, self.layout.rooms[index]
        rect, content = room.rect, furniture.SETS[room.kind]
        perimeter_m = 2 * (rect.width + rect.height) * RESOLUTION_M
        for side in range(4):
            length_m = (rect.height if side < 2 else rect.width) * RESOLUTION_M
            if self._outside(rect, side):
                for _ in range(int(rng.poisson(content.windows * length_m))):
                    self._at_wall(index, furniture.window(rng), side)
        for _ in range(int(rng.poisson(0.05 * perimeter_m))):
            self._at_wall(index, furniture.closed_door(rng), int(rng.integers(4)))
        for factory in content.wanted:
            piece, first = factory(rng), int(rng.integers(4))
            for side in range(first, first + 4):
                if self._at_wall(index, piece, side % 4):
                    break
        if content.rows and rng.random() < content.rows:
            self._rows(index)
        # Some homes are full and some nearly empty.
        density = content.density * rng.uniform(0.3, 1.3)
        for _ in range(int(rng.poisson(0.3 * rect.area_m2 * density))):
            if content.free:
                self._free(index, content.free[int(rng.integers(len(content.free)))](rng))
        for _ in range(int(rng.poisson(1.1 * perimeter_m * density))):
            piece = content.walls[int(rng.integers(len(content.walls)))](rng)
            self._at_wall(index, piece, int(rng.integers(4)))

    def _rows(self, index: int) -> None:
        """Stand racks in rows, with aisles between them along which one drives."""
        rng, rect = self.rng, self.layout.rooms[index].rect
        along_x, filled = bool(rng.random() < 0.5), rng.uniform(0.2, 0.9)
        length, across = (rect.width, rect.height) if along_x else (rect.height, rect.width)
        aisle = to_cells(rng.uniform(1.6, 4.0))
        row = aisle
        while row + 2 * WALKWAY < across - aisle:
            column, deepest = 2 * WALKWAY, 0
            while column < length - 2 * WALKWAY:
                piece, angle = furniture.high_rack(rng), math.pi * int(rng.integers(2))
                width, depth = to_cells(piece.width_m), to_cells(piece.depth_m)
                x, y, dx, dy = column, row, width, depth
                if not along_x:
                    x, y, dx, dy, angle = y, x, dy, dx, angle + 0.5 * math.pi
                x, y = rect.x0 + x, rect.y0 + y
                box = Rect(x, y, x + dx, y + dy)
                column += width + WALKWAY * int(rng.integers(3))
                fits = column < length - 2 * WALKWAY and self._fits(box, piece)
                if fits and rng.random() < filled:
                    self._put(index, piece, box, angle)
                    self.used[box.slices] = True
                    deepest = max(deepest, depth)
            row += deepest + aisle

    def _outside(self, rect: Rect, side: int) -> bool:
        """Whether the wall at `side` (left, right, bottom, top) is an outer wall."""
        rows, columns = self.layout.shape
        margin = (rect.x0, columns - rect.x1, rect.y0, rows - rect.y1)[side]
        return margin <= 5

    def _at_wall(self, index: int, piece: Piece, side: int) -> bool:
        """Try to stand a piece with its back to a wall; return whether there was space."""
        rect = self.layout.rooms[index].rect
        width, depth = max(to_cells(piece.width_m), 1), max(to_cells(piece.depth_m), 1)
        length = rect.height if side < 2 else rect.width
        across = rect.width if side < 2 else rect.height
        flat = depth == 1
        if width > length or (not flat and depth > across - 18):
            return False
        for _ in range(4):
            start = int(self.rng.integers(length - width + 1))
            if self.rng.random() < 0.25 and not flat:  # into a corner
                start = 0 if self.rng.random() < 0.5 else length - width
            if side < 2:
                x0 = rect.x0 if side == 0 else rect.x1 - depth
                box = Rect(x0, rect.y0 + start, x0 + depth, rect.y0 + start + width)
            else:
                y0 = rect.y0 if side == 2 else rect.y1 - depth
                box = Rect(rect.x0 + start, y0, rect.x0 + start + width, y0 + depth)
            if not self._wall_behind(box, side) or not self._fits(box, piece):
                continue
            # v points away from the wall: its angle less a quarter turn.
            angle = (-0.5 * math.pi, 0.5 * math.pi, 0.0, math.pi)[side]
            self._put(index, piece, box, angle)
            if flat and piece.parts[0].bottom_m > 0.0:
                self.low_only[box.slices] = True
            else:
                dx, dy = (12, 0) if side < 2 else (0, 12)
                front = box.grown(dx, dy) if flat else box
                self.used[front.slices] = True
            return True
        return False

    def _wall_behind(self, box: Rect, side: int) -> bool:
        rows, columns = box.slices
        behind = (
            (rows, slice(box.x0 - 1, box.x0)),
            (rows, slice(box.x1, box.x1 + 1)),
            (slice(box.y0 - 1, box.y0), columns),
            (slice(box.y1, box.y1 + 1), columns),
        )[side]
        return bool(self.wall[behind].all())

    def _free(self, index: int, piece: Piece) -> None:
        """Try to stand a piece with a walkway all round."""
        rect = self.layout.rooms[index].rect
        turned = bool(self.rng.random() < 0.5)
        angle = 0.5 * math.pi * turned + math.pi * int(self.rng.integers(2))
        size = (piece.depth_m, piece.width_m) if turned else (piece.width_m, piece.depth_m)
        if self.rng.random() < 0.25:  # askew
            skew = self.rng.uniform(-0.6, 0.6)
            angle += skew
            cos, sin = math.cos(skew), abs(math.sin(skew))
            size = size[0] * cos + size[1] * sin, size[1] * cos + size[0] * sin
        width, height = (max(to_cells(s), 2) for s in size)
        if width + 2 * WALKWAY > rect.width or height + 2 * WALKWAY > rect.height:
            return
        for _ in range(4):
            x0 = int(self.rng.integers(rect.x0 + WALKWAY, rect.x1 - WALKWAY - width + 1))
            y0 = int(self.rng.integers(rect.y0 + WALKWAY, rect.y1 - WALKWAY - height + 1))
            box = Rect(x0, y0, x0 + width, y0 + height)
            around = box.grown(WALKWAY, WALKWAY)
            if not self.used[around.slices].any() and self._fits(box, piece):
                self._put(index, piece, box, angle)
                self.used[box.slices] = True
                return

    def _fits(self, box: Rect, piece: Piece) -> bool:
        taken = self.used[box.slices].any() or self.kept_free[box.slices].any()
        hidden = piece.top_m > 0.8 and self.low_only[box.slices].any()
        return not (taken or hidden)

    def _put(self, index: int, piece: Piece, box: Rect, angle: float) -> None:
        x_m = 0.5 * (box.x0 + box.x1) * RESOLUTION_M
        y_m = 0.5 * (box.y0 + box.y1) * RESOLUTION_M
        footprints = (_rasterise(part, x_m, y_m, angle) for part in piece.parts)
        self.placed.append(Placed(index, tuple(f for f in footprints if f is not None)))

    def _hang_door_leaves(self) -> None:
        """Leave some doors open: a thin leaf, hinged beside the gap, turned out of the way."""
        rng = self.rng
        for opening in self.layout.openings:
            if opening.width > 20 or rng.random() > 0.45:
                continue
            rect, up = opening.rect, bool(rng.integers(2))
            into_second, length_m = bool(rng.integers(2)), opening.width * RESOLUTION_M
            leaf = furniture.closed_door(rng).parts[0]
            # Angle from the closed leaf; from a right angle on, the gap stays open.
            swing = rng.uniform(math.radians(92.0), math.radians(150.0))
            along, out = -math.cos(swing) * length_m, math.sin(swing) * length_m
            gap = (rect.x0, rect.x1) if opening.along_x else (rect.y0, rect.y1)
            ends = (rect.y0, rect.y1) if opening.along_x else (rect.x0, rect.x1)
            hinge_along = (ends[1] + 0.6 if up else ends[0] - 0.6) * RESOLUTION_M
            hinge_out = (gap[1] if into_second else gap[0]) * RESOLUTION_M
            middle_along = hinge_along + (0.5 if up else -0.5) * along
            middle_out = hinge_out + (0.5 if into_second else -0.5) * out
            x_m, y_m = middle_out, middle_along
            dx, dy = out if into_second else -out, along if up else -along
            if not opening.along_x:
                x_m, y_m, dx, dy = y_m, x_m, dy, dx
            part = Part(0.0, 0.0, length_m, 0.07, 0.0, leaf.top_m, leaf.side, leaf.cap, True)
            print_ = _rasterise(part, x_m, y_m, math.atan2(dy, dx))
            room = opening.second if into_second else opening.first
            inside = self.layout.rooms[room].rect
            if print_ is None or min(inside.width, inside.height) < to_cells(length_m + 0.9):
                continue
            wall = self.wall[print_.where]
            if wall.shape != print_.mask.shape:  # it would reach out of the world
                continue
            others = (o for o in self.layout.openings if o is not opening)
            if any(_overlaps(print_, _zone(other, 0)) for other in others):
                continue
            mask = print_.mask & ~wall
            self.placed.append(Placed(room, (Footprint(part, print_.where, mask),)))
            self.used[print_.where] |= mask

    def _blocked(self) -> NDArray[np.bool_]:
        blocked = self.wall.copy()
        for placed in self.placed:
            for footprint in placed.footprints:
                if footprint.part.bottom_m < BLOCKING_HEIGHT_M:
                    blocked[footprint.where] |= footprint.mask
        return blocked

    def _reconnect(self) -> None:
        """Remove pieces until all floor with 0.3 m of clearance is one part."""
        while True:
            free = (~self._blocked()).astype(np.uint8)
            clearance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            clear = (clearance > PASSABLE_CELLS).astype(np.uint8)
            count, labels, stats, _ = cv2.connectedComponentsWithStats(clear, connectivity=4)
            if count <= 2 and self._rooms_open(clear):
                return
            main = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if count > 1 else 0
            removed: set[int] = set()
            for label in range(1, count):
                if label == main:
                    continue
                x, y, w, h = (int(v) for v in stats[label, :4])
                pocket = Rect(x, y, x + w, y + h).grown(9, 9)
                removed |= self._candidate(pocket, removed)
            for room in self.layout.rooms:
                if not (labels[room.rect.slices] == main).any():
                    removed |= self._candidate(room.rect, removed)
            assert removed, "walls alone cut the floor; the layout promises they do not"
            self.placed = [p for k, p in enumerate(self.placed) if k not in removed]

    def _rooms_open(self, clear: NDArray[np.uint8]) -> bool:
        return all(clear[room.rect.slices].any() for room in self.layout.rooms)

    def _candidate(self, area: Rect, removed: set[int]) -> set[int]:
        """Choose one piece that blocks cells in `area`."""
        found = [
            k
            for k, placed in enumerate(self.placed)
            if k not in removed and any(_overlaps(f, area) for f in placed.footprints)
        ]
        return {found[int(self.rng.integers(len(found)))]} if found else set()


def _zone(opening: Opening, beside: int) -> Rect:
    """Return what is kept free before and behind an opening, `beside` cells wider than it."""
    dx, dy = (DOOR_ZONE, beside) if opening.along_x else (beside, DOOR_ZONE)
    return opening.rect.grown(dx, dy)


def _overlaps(footprint: Footprint, area: Rect) -> bool:
    rows, columns = footprint.where
    across = columns.start < area.x1 and columns.stop > area.x0
    low = footprint.part.bottom_m < BLOCKING_HEIGHT_M
    return low and across and rows.start < area.y1 and rows.stop > area.y0
