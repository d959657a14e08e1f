"""Generated worlds: houses, apartments and offices with doors, furniture, pictures and windows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from cbe_hil_sim import textures
from cbe_hil_sim.world import RESOLUTION_M, Surfaces, World

TRAIN_SEEDS = range(100_000)
VALIDATION_SEEDS = range(100_000, 110_000)
TEST_SEEDS = range(200_000, 210_000)

Rect = tuple[int, int, int, int]  # row, column, rows, columns in cells
_BORDER = 4  # cells of the outer wall
_PASSABLE_M = 0.3


def split_of(seed: int) -> str:
    """Texture split of a seed."""
    return "train" if seed < 100_000 else "validation" if seed < 200_000 else "test"


def generate(seed: int) -> World:
    """Build the world of `seed`, the same on any machine; its split decides its textures."""
    return _Builder(seed).build()


@dataclass(slots=True)
class _Item:
    """A piece of furniture: its footprint and what it was before, to take it back."""

    rect: Rect
    room: int


class _Builder:
    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = np.random.default_rng([seed, 0])
        rng = self.rng
        area = rng.uniform(100.0, 420.0)
        aspect = rng.uniform(0.6, 1.6)
        self.rows = int(np.sqrt(area * aspect) / RESOLUTION_M)
        self.columns = int(np.sqrt(area / aspect) / RESOLUTION_M)
        self.ceiling = float(rng.uniform(2.3, 3.2))
        self.office = bool(rng.random() < 0.35)
        self.bank = textures.bank(split_of(seed))
        shape = (self.rows, self.columns)
        self.solid = np.full(shape, self.ceiling, np.float32)
        self.span_bottom = np.zeros(shape, np.float32)
        self.span_top = np.zeros(shape, np.float32)
        self.side, self.cap, self.span, self.floor, self.roof = np.zeros((5, *shape), np.uint16)
        self.taken = np.ones(shape, np.bool_)
        self.room_of = np.full(shape, -1)
        self.texture: list[int] = []
        self.origin: list[tuple[float, float, float]] = []
        self.size: list[tuple[float, float]] = []
        self.tint: list[NDArray[np.floating]] = []

    # --- surfaces -------------------------------------------------------------------------

    def surface(
        self,
        families: tuple[str, ...],
        tint: NDArray[np.floating],
        size: tuple[float, float],
        origin: tuple[float, float, float] | None = None,
    ) -> int:
        """Add a surface with a random texture of one of the families."""
        family = families[int(self.rng.integers(len(families)))]
        options = textures.FAMILIES[family]
        self.texture.append(options[int(self.rng.integers(len(options)))])
        offset = self.rng.uniform(0.0, 5.0, 2)
        self.origin.append(origin if origin else (float(offset[0]), float(offset[1]), 0.0))
        self.size.append(size)
        self.tint.append(tint)
        return len(self.texture) - 1

    # --- rooms ----------------------------------------------------------------------------

    def split(self, rect: Rect, rooms: list[Rect]) -> None:
        """Cut a rectangle into rooms, leaving walls between them."""
        rng = self.rng
        row, column, rows, columns = rect
        wall = int(rng.integers(2, 5))
        small = 55 if not self.office else 50  # cells: 2.5 m
        longest = max(rows, columns)
        area = rows * columns * RESOLUTION_M**2
        if longest < 2 * small + wall or (area < rng.uniform(12.0, 40.0)):
            rooms.append(rect)
            return
        along_rows = rows >= columns if rng.random() < 0.85 else rows < columns
        length = rows if along_rows else columns
        if length < 2 * small + wall:
            along_rows, length = not along_rows, columns if along_rows else rows
        if area > 90.0 and rng.random() < (0.8 if self.office else 0.4):
            width = int(rng.integers(24, 40))  # a corridor of 1.2 to 2 m
            at = int(rng.integers(small, max(small + 1, length - small - width - 2 * wall)))
            cuts = [(0, at), (at + wall, width), (at + 2 * wall + width, length - at - 2 * wall - width)]
        else:
            at = int(rng.integers(small, length - small - wall + 1))
            cuts = [(0, at), (at + wall, length - at - wall)]
        for index, (begin, size) in enumerate(cuts):
            if size < 20:
                continue
            part = (
                (row + begin, column, size, columns)
                if along_rows
                else (row, column + begin, rows, size)
            )
            if len(cuts) == 3 and index == 1:
                rooms.append(part)
            else:
                self.split(part, rooms)

    def paint_rooms(self, rooms: list[Rect]) -> None:
        """Floors, ceilings and wallpaper; some rooms share theirs."""
        rng = self.rng
        gains = np.exp(rng.normal(0.0, 0.22, len(rooms)))
        shared: list[tuple[tuple[str, ...], float]] = []
        plain = rng.random() < 0.35
        self.light = []
        wall_of = np.zeros(len(rooms), np.uint16)
        floor_style = (("wood_floor",), ("tile_floor", "checker"), ("carpet",), ("parquet", "marble"))
        common_floor = floor_style[int(rng.integers(4))]
        for index, (row, column, rows, columns) in enumerate(rooms):
            light = gains[index] * np.exp(rng.normal(0.0, 0.05, 3))
            self.light.append(light)
            style: tuple[str, ...] = ("plaster",) if plain else ("plaster", "wallpaper", "wallpaper", "mural")
            if not plain and rng.random() < 0.2:
                style = ("brick", "panelling", "tiled_wall")
            wide = float(rng.uniform(2.0, 5.0))
            if shared and rng.random() < 0.35:
                self.texture.append(self.texture[shared[-1][0]])  # type: ignore[index]
                self.origin.append(self.origin[shared[-1][0]])  # type: ignore[index]
                self.size.append(self.size[shared[-1][0]])  # type: ignore[index]
                self.tint.append(light)
                wall = len(self.texture) - 1
            else:
                wall = self.surface(style, light, (wide, self.ceiling))
                shared.append((wall, wide))  # type: ignore[arg-type]
            wall_of[index] = wall
            floor_family = common_floor if rng.random() < 0.5 else floor_style[int(rng.integers(4))]
            repeat = float(rng.uniform(1.0, 3.0))
            floor = self.surface(floor_family, light, (repeat, repeat))
            repeat = float(rng.uniform(1.2, 3.0))
            roof = self.surface(("plain_ceiling", "panel_ceiling"), light, (repeat, repeat))
            area = np.s_[row : row + rows, column : column + columns]
            self.solid[area] = 0.0
            self.taken[area] = False
            self.floor[area], self.roof[area] = floor, roof
            self.room_of[area] = index
        nearest = ndimage.distance_transform_edt(
            self.room_of < 0, return_distances=False, return_indices=True
        )
        self.nearest = self.room_of[tuple(nearest)]
        self.side[:] = self.cap[:] = self.span[:] = wall_of[self.nearest]
        self.wall_of = wall_of
        for grid in (self.floor, self.roof):
            grid[:] = grid[tuple(nearest)]

    def cut_doors(self, rooms: list[Rect]) -> None:
        """Connect neighbouring rooms: a spanning tree of doors and some more."""
        rng = self.rng
        edges = []
        for a, (ra, ca, ha, wa) in enumerate(rooms):
            for b, (rb, cb, hb, wb) in enumerate(rooms):
                for gap, low, high, vertical in (
                    (cb - (ca + wa), max(ra, rb), min(ra + ha, rb + hb), True),
                    (rb - (ra + ha), max(ca, cb), min(ca + wa, cb + wb), False),
                ):
                    if 0 < gap <= 6 and high - low >= 26:
                        edges.append((a, b, gap, low, high, vertical))
        group = list(range(len(rooms)))
        for k in rng.permutation(len(edges)):
            a, b, gap, low, high, vertical = edges[k]
            joined = group[a] == group[b]
            if joined and rng.random() > 0.25:
                continue
            if not joined:
                old, new = group[a], group[b]
                group = [new if g == old else g for g in group]
            opening = rng.random() < 0.2 and high - low > 44
            width = int(rng.integers(26, min(50, high - low - 8))) if opening else int(rng.integers(17, 21))
            at = int(rng.integers(low + 3, high - width - 2))
            start = (rooms[a][1] + rooms[a][3]) if vertical else (rooms[a][0] + rooms[a][2])
            area = (
                np.s_[at : at + width, start : start + gap]
                if vertical
                else np.s_[start : start + gap, at : at + width]
            )
            self.solid[area] = 0.0
            if not (opening and rng.random() < 0.4):
                self.span_bottom[area] = min(float(rng.uniform(2.0, 2.12)), self.ceiling - 0.1)
                self.span_top[area] = self.ceiling
            margin = 20  # a metre before doors stays free
            r, c = area
            self.taken[
                max(0, r.start - margin * (not vertical) - 3) : r.stop + margin * (not vertical) + 3,
                max(0, c.start - margin * vertical - 3) : c.stop + margin * vertical + 3,
            ] = True
            if not opening and rng.random() < 0.35:
                self.hang_leaf(area, vertical)

    def hang_leaf(self, area: tuple[slice, slice], vertical: bool) -> None:
        """Add an open door leaf: a thin slab beside the doorway, at right angles to the wall."""
        r, c = area
        depth = int(self.rng.integers(14, 18))
        sign = int(self.rng.integers(2))
        end = int(self.rng.integers(2))
        if vertical:
            line = r.start - 1 if end == 0 else r.stop
            first = c.stop if sign else c.start - depth
            place = np.s_[line : line + 1, max(first, 0) : first + depth]
        else:
            line = c.start - 1 if end == 0 else c.stop
            first = r.stop if sign else r.start - depth
            place = np.s_[max(first, 0) : first + depth, line : line + 1]
        if self.solid[place].size == 0 or self.solid[place].max() > 0:
            return
        light = self.light[self.nearest[place].flat[0]]
        y0, x0 = place[0].start * RESOLUTION_M, place[1].start * RESOLUTION_M
        door = self.surface(("door",), light, (depth * RESOLUTION_M, 2.0), (x0, y0, 0.0))
        self.solid[place] = 2.0
        self.side[place] = self.cap[place] = door

    # --- furniture ------------------------------------------------------------------------

    def furnish(self, index: int, room: Rect) -> None:
        """Stand furniture along the walls and, in larger rooms, free."""
        rng = self.rng
        row, column, rows, columns = room
        area = rows * columns * RESOLUTION_M**2
        if min(rows, columns) < 42:  # a corridor keeps to a few slim things
            for _ in range(int(rng.integers(0, 4))):
                self.place(index, room, (int(rng.integers(6, 24)), int(rng.integers(4, 7))), wall=True)
            return
        for _ in range(int(rng.poisson(2.0 + area / 4.5))):
            self.place(index, room, (int(rng.integers(8, 44)), int(rng.integers(7, 20))), wall=True)
        for _ in range(int(rng.poisson(area / 14.0))):
            self.place(index, room, (int(rng.integers(8, 36)), int(rng.integers(8, 26))), wall=False)
        if rng.random() < 0.5:  # a rug
            h, w = int(rng.integers(20, max(21, rows - 10))), int(rng.integers(20, max(21, columns - 10)))
            r = row + int(rng.integers(0, max(1, rows - h)))
            c = column + int(rng.integers(0, max(1, columns - w)))
            h, w = min(h, rows), min(w, columns)
            size = (w * RESOLUTION_M, h * RESOLUTION_M)
            rug = self.surface(("rug",), self.light[index], size, (c * RESOLUTION_M, r * RESOLUTION_M, 0.0))
            self.floor[r : r + h, c : c + w] = rug

    def place(self, index: int, room: Rect, size: tuple[int, int], *, wall: bool) -> None:
        """Try a few places for one piece of `size` (width, depth) cells."""
        rng = self.rng
        row, column, rows, columns = room
        for _ in range(6):
            edge = int(rng.integers(4))
            h, w = (size[1], size[0]) if edge < 2 else (size[0], size[1])
            if h > rows - 4 or w > columns - 4:
                return
            r, c = row + int(rng.integers(0, rows - h + 1)), column + int(rng.integers(0, columns - w + 1))
            if wall:
                r = (row, row + rows - h, r, r)[edge]
                c = (c, c, column, column + columns - w)[edge]
            elif min(r - row, c - column, row + rows - r - h, column + columns - c - w) < 16:
                continue
            if self.taken[r : r + h, c : c + w].any():
                continue
            self.stand(index, (r, c, h, w), wall=wall)
            around = 14 if not wall else 6  # room to pass between pieces
            self.taken[max(r - around, 0) : r + h + around, max(c - around, 0) : c + w + around] = True
            return

    def stand(self, index: int, rect: Rect, *, wall: bool) -> None:
        """Fill a footprint with a random kind of furniture."""
        rng = self.rng
        r, c, h, w = rect
        area = np.s_[r : r + h, c : c + w]
        light = self.light[index] * rng.uniform(0.85, 1.1)
        origin = (c * RESOLUTION_M, r * RESOLUTION_M, 0.0)
        wide = max(h, w) * RESOLUTION_M
        flat = (w * RESOLUTION_M, h * RESOLUTION_M)
        kind = rng.random()
        small = max(h, w) < 14
        if kind < 0.3 and not small:  # table or desk: a top on legs
            top = float(rng.uniform(0.45, 0.8))
            board = self.surface(("wood", "lacquer"), light, flat, origin)
            leg = self.surface(("wood", "lacquer"), light, (wide, top), origin)
            self.span_bottom[area], self.span_top[area] = top - 0.05, top
            self.span[area] = board
            for y in (r, r + h - 1):
                for x in (c, c + w - 1):
                    self.solid[y, x] = top - 0.05
                    self.side[y, x] = self.cap[y, x] = leg
            if rng.random() < 0.5:  # a drawer block or something on it
                part = np.s_[r : r + h, c : c + max(2, w // 4)]
                self.solid[part] = top - 0.05
                self.side[part] = self.cap[part] = leg
            return
        if wall and kind < 0.62:
            height = float(rng.choice([rng.uniform(0.4, 0.9), rng.uniform(0.9, 1.5), rng.uniform(1.6, 2.2)]))
            families: tuple[str, ...] = ("cabinet", "cabinet", "bookshelf", "appliance", "wood")
            if height < 1.0:
                families = ("cabinet", "lacquer", "wood", "appliance", "screen")
        elif kind < 0.75:  # sofa or bed: soft, low
            height, families = float(rng.uniform(0.35, 0.6)), ("fabric", "bedding")
        elif kind < 0.85 and small:
            height, families = float(rng.uniform(0.5, 1.6)), ("foliage",)
        else:
            height, families = float(rng.uniform(0.2, 1.0)), ("box", "fabric", "lacquer", "wood", "photo")
        height = min(height, self.ceiling - 0.05)
        side = self.surface(families, light, (wide, height), origin)
        top_families = families if families == ("fabric", "bedding") else ("wood", "lacquer")
        cap = self.surface(top_families, light, flat, origin)
        self.solid[area] = height
        self.side[area], self.cap[area] = side, cap
        if families == ("fabric", "bedding") and rng.random() < 0.7:  # a back rest
            back = np.s_[r : r + h, c : c + 3] if h > w else np.s_[r : r + 3, c : c + w]
            self.solid[back] = height + float(rng.uniform(0.25, 0.5))

    def hang(self, index: int, room: Rect) -> None:
        """Pictures, windows, screens and shelves on a room's walls, one cell deep."""
        rng = self.rng
        row, column, rows, columns = room
        spots = int(rng.poisson(0.35 * (rows + columns) * 2 * RESOLUTION_M / (4.0 if self.office else 2.2)))
        for _ in range(spots):
            edge, width = int(rng.integers(4)), int(rng.integers(7, 32))
            length = columns if edge < 2 else rows
            if width > length - 6:
                continue
            at = int(rng.integers(3, length - width - 2))
            if edge < 2:
                r = row if edge == 0 else row + rows - 1
                area = np.s_[r : r + 1, column + at : column + at + width]
                behind = np.s_[r - 1 : r, area[1]] if edge == 0 else np.s_[r + 1 : r + 2, area[1]]
            else:
                c = column if edge == 2 else column + columns - 1
                area = np.s_[row + at : row + at + width, c : c + 1]
                behind = np.s_[area[0], c - 1 : c] if edge == 2 else np.s_[area[0], c + 1 : c + 2]
            if self.solid[behind].min() < self.ceiling or self.span_top[area].max() > 0:
                continue
            bottom = float(rng.uniform(1.12, 1.5))
            bottom = max(bottom, float(self.solid[area].max()) + 0.05)
            top = min(bottom + float(rng.uniform(0.35, 1.1)), self.ceiling - 0.1)
            if top - bottom < 0.25:
                continue
            families = ("picture", "picture", "window", "photo", "screen", "bookshelf")
            origin = (area[1].start * RESOLUTION_M, area[0].start * RESOLUTION_M, bottom)
            light = self.light[index] * rng.uniform(0.9, 1.15)
            size = (width * RESOLUTION_M, top - bottom)
            self.span[area] = self.surface(families, light, size, origin)
            self.span_bottom[area], self.span_top[area] = bottom, top

    # --- assembly -------------------------------------------------------------------------

    def clear(self, rooms: list[Rect]) -> None:
        """Empty rooms whose furniture cuts something off."""
        for _ in range(3):
            blocked = (self.solid > 0.03) | ((self.span_top > 0.03) & (self.span_bottom < 1.1))
            clearance = ndimage.distance_transform_edt(~blocked) * RESOLUTION_M
            label, count = ndimage.label(clearance > _PASSABLE_M)
            if count <= 1:
                return
            sizes = ndimage.sum_labels(np.ones_like(label), label, np.arange(1, count + 1))
            main = int(np.argmax(sizes)) + 1
            for index, (row, column, rows, columns) in enumerate(rooms):
                area = np.s_[row : row + rows, column : column + columns]
                here = label[area]
                cut_off = ((here > 0) & (here != main)).sum()
                if cut_off > 60 or not (here == main).any():
                    self.solid[area] = 0.0
                    low = self.span_bottom[area] < 1.1
                    self.span_top[area] = np.where(low, 0.0, self.span_top[area])
                    self.span_bottom[area] = np.where(low, 0.0, self.span_bottom[area])

    def build(self) -> World:
        rooms: list[Rect] = []
        inner = (_BORDER, _BORDER, self.rows - 2 * _BORDER, self.columns - 2 * _BORDER)
        self.split(inner, rooms)
        self.paint_rooms(rooms)
        self.cut_doors(rooms)
        for index, room in enumerate(rooms):
            self.furnish(index, room)
            self.hang(index, room)
        self.clear(rooms)
        tint = np.clip(np.array(self.tint, np.float32), 0.2, 1.4)
        return World(
            self.solid, self.span_bottom, self.span_top, self.side, self.cap, self.span,
            self.floor, self.roof, self.ceiling,
            Surfaces(
                np.array(self.texture, np.int32),
                np.array(self.origin, np.float32),
                np.array(self.size, np.float32),
                tint,
            ),
            self.bank,
            name=f"generated-{self.seed}",
        )  # fmt: skip
