"""Generated worlds: furnished houses, apartments, offices and halls from a seed."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cbe.errors import WorldError
from cbe_hil_sim.layout import DEPOT, HALL, Layout, Opening, Rect, Style, draw_layout, to_cells
from cbe_hil_sim.patterns import colour
from cbe_hil_sim.placing import Footprint, Placer
from cbe_hil_sim.surfacing import Look, SurfaceTable, Tint, draw_looks, pick
from cbe_hil_sim.textures import bank
from cbe_hil_sim.world import RESOLUTION_M, World

TRAIN_SEEDS = range(100_000)
VALIDATION_SEEDS = range(100_000, 110_000)
TEST_SEEDS = range(200_000, 210_000)
SPLIT_SEEDS = {"train": TRAIN_SEEDS, "validation": VALIDATION_SEEDS, "test": TEST_SEEDS}

HALL_EVERY = 3
"""Every so many worlds, the last one is of halls."""

DEPOT_SEEDS = {"train": TRAIN_SEEDS[90_000:], "validation": VALIDATION_SEEDS[9_000:]}
"""Worlds of depots; there are none to test in, for warehouses of others' making do that."""


@dataclass(frozen=True, slots=True)
class Marks:
    """How floors of a kind of room are taped."""

    chance: float  # that there are any
    zones: tuple[int, int]  # a room, the second excluded
    lanes: float  # share of the zones
    widest_m: float


MARKS = {
    "hall": Marks(0.7, (1, 10), 0.6, 6.0),
    # A lane along which one drives looks as if one stood.
    "depot": Marks(0.9, (4, 20), 0.85, 3.0),
}

Rng = np.random.Generator
Heights = NDArray[np.float32]
Rows = NDArray[np.uint16]


def split_of(seed: int) -> str:
    """Return the split a seed belongs to, and so its texture bank.

    Raises:
        WorldError: the seed is in none of the ranges.
    """
    for split, seeds in SPLIT_SEEDS.items():
        if seed in seeds:
            return split
    ranges = ", ".join(f"{k} {v.start}..{v.stop - 1}" for k, v in SPLIT_SEEDS.items())
    raise WorldError(f"world seed {seed} is in no split; use one of: {ranges}")


def is_hall(seed: int) -> bool:
    """Whether the world of `seed` is of halls: few, large, high rooms with bare floors."""
    return seed % HALL_EVERY == HALL_EVERY - 1 and not is_depot(seed)


def is_depot(seed: int) -> bool:
    """Whether the world of `seed` is a depot: one large high room, mostly, with high racks."""
    return any(seed in seeds for seeds in DEPOT_SEEDS.values())


def style_of(seed: int) -> Style | None:
    """What `draw_layout` is told of the world of `seed`; None for homes and offices."""
    return DEPOT if is_depot(seed) else HALL if is_hall(seed) else None


TEST_HOUSES = [seed for seed in TEST_SEEDS if not is_hall(seed)]
"""Test worlds of many rooms, with ways through several doors."""


def generate(seed: int) -> World:
    """Build the world of `seed`, the same one each time; all its floor is reachable.

    Every floor cell with at least 0.3 m of clearance can be reached from every other.

    Raises:
        WorldError: the seed is in none of the splits' ranges.
    """
    split = split_of(seed)
    rng = np.random.default_rng([seed, 7])
    style = style_of(seed)
    layout = draw_layout(rng, style)
    ceiling_m = rng.uniform(*_ceiling_m(style))
    builder = Builder(layout, rng, round(float(ceiling_m), 2))
    builder.build()
    return builder.finish(bank(split), f"{layout.style}-{seed}")


def _ceiling_m(style: Style | None) -> tuple[float, float]:
    """Lowest and highest."""
    if style is None:
        return 2.3, 3.2
    return 2.5, 11.0 if style is DEPOT else 9.0


@dataclass(slots=True)
class Builder:
    """Paints a layout, its furniture and what hangs on its walls into a world's grids."""

    layout: Layout
    rng: Rng
    ceiling_m: float
    table: SurfaceTable = field(init=False, default_factory=SurfaceTable)
    looks: list[Look] = field(init=False)
    solid_top: Heights = field(init=False)
    span_bottom: Heights = field(init=False)
    span_top: Heights = field(init=False)
    side: Rows = field(init=False)
    cap: Rows = field(init=False)
    span: Rows = field(init=False)
    floor: Rows = field(init=False)
    ceiling: Rows = field(init=False)

    def __post_init__(self) -> None:
        """Start from solid wall everywhere."""
        shape = self.layout.shape
        self.solid_top = np.full(shape, self.ceiling_m, np.float32)
        self.span_bottom, self.span_top = np.zeros((2, *shape), np.float32)
        self.side, self.cap, self.span, self.floor, self.ceiling = np.zeros((5, *shape), np.uint16)
        kinds = [room.kind for room in self.layout.rooms]
        self.looks = draw_looks(self.rng, kinds, self.layout.style)
        self.table.add(pick(self.rng, "plaster"), (3.0, self.ceiling_m), np.full(3, 0.9))

    def build(self) -> None:
        """Paint rooms, openings, furniture, lights and pictures, in this order."""
        for index in range(len(self.layout.rooms)):
            self._paint_room(index)
        framed = bool(self.rng.random() < 0.75)
        frame = pick(self.rng, "wood", "lacquer", "plain_ceiling")
        for opening in self.layout.openings:
            self._cut(opening, frame if framed else None)
        for placed in Placer(self.layout, self.rng).furnish():
            shade = self.rng.uniform(0.85, 1.15) * self.looks[placed.room].tint
            for footprint in placed.footprints:
                self._stand(footprint, shade)
        for index in range(len(self.layout.rooms)):
            self._light_room(index)
            self._hang_pictures(index)

    def finish(self, textures: NDArray[np.uint8], name: str) -> World:
        """Return the finished world, no span reaching into what stands under it."""
        hidden = self.solid_top >= self.span_top
        self.span_top[hidden] = self.span_bottom[hidden] = 0.0
        self.span_bottom = np.where(hidden, 0.0, np.maximum(self.span_bottom, self.solid_top))
        return World(
            self.solid_top, self.span_bottom, self.span_top, self.side, self.cap, self.span,
            self.floor, self.ceiling, self.ceiling_m, self.table.finish(), textures, name=name,
        )  # fmt: skip

    def _paint_room(self, index: int) -> None:
        rect, look, rng = self.layout.rooms[index].rect, self.looks[index], self.rng
        self.solid_top[rect.slices] = 0.0
        size = (look.floor_size_m, look.floor_size_m)
        offset = (float(rng.uniform(0, 3)), float(rng.uniform(0, 3)), 0.0)
        floor_tint = look.tint * look.floor_tint
        self.floor[rect.slices] = self.table.add(look.floor, size, floor_tint, offset)
        self.ceiling[rect.slices] = self.table.add(look.ceiling, (2.4, 2.4), look.tint)
        for texture, strip in zip(look.walls, _strips(rect), strict=True):
            offset = (float(rng.uniform(0, 5)), float(rng.uniform(0, 5)), 0.0)
            repeat = (look.wall_width_m, self.ceiling_m / max(round(self.ceiling_m / 3.0), 1))
            row = self.table.add(texture, repeat, look.tint, offset)
            self.side[strip] = self.span[strip] = row
        if rng.random() < 0.4 and min(rect.width, rect.height) > 40:
            rug = self._somewhere(rect, (1.0, 3.2), 4)
            self.floor[rug.slices] = self._fitted(pick(rng, "rug"), rug, look.tint)
        marks = MARKS.get(self.layout.rooms[index].kind)
        if marks is not None and rng.random() < marks.chance:
            self._mark_floor(rect, look.tint, marks)

    def _mark_floor(self, rect: Rect, light: Tint, marks: Marks) -> None:
        """Tape outlines of zones onto a floor, a share of them lanes from wall to wall."""
        rng, paint = self.rng, pick(self.rng, "plain_ceiling")
        tapes = [
            self.table.add(paint, (3.0, 3.0), light * colour(rng, (0.0, 0.9), (0.1, 0.9)) / 255.0)
            for _ in range(int(rng.integers(1, 4)))
        ]
        for _ in range(int(rng.integers(*marks.zones))):
            zone = self._somewhere(rect, (0.6, marks.widest_m), 2)
            if rng.random() < marks.lanes:
                x, y = (rect, zone) if rng.random() < 0.5 else (zone, rect)
                zone = Rect(x.x0, y.y0, x.x1, y.y1)
            floor, width = self.floor[zone.slices], int(rng.integers(1, 4))
            taped = np.ones(floor.shape, np.bool_)
            taped[width:-width, width:-width] = False
            if rng.random() < 0.4:
                dash = int(rng.integers(2, 30))
                taped &= np.indices(floor.shape).sum(axis=0) // dash % 2 == 0
            floor[taped] = int(rng.choice(tapes))

    def _cut(self, opening: Opening, frame: int | None) -> None:
        """Open a wall: free below, a lintel above; each half belongs to the nearer room."""
        rect = opening.rect
        self.solid_top[rect.slices] = 0.0
        second = (
            Rect((rect.x0 + rect.x1) // 2, rect.y0, rect.x1, rect.y1)
            if opening.along_x
            else Rect(rect.x0, (rect.y0 + rect.y1) // 2, rect.x1, rect.y1)
        )
        for room, half in ((opening.first, rect), (opening.second, second)):
            beyond = self.layout.rooms[room].rect
            self.floor[half.slices] = self.floor[beyond.y0, beyond.x0]
            self.ceiling[half.slices] = self.ceiling[beyond.y0, beyond.x0]
        if opening.lintel_m:  # the wall's own surface is already there, from both rooms
            self.span_bottom[rect.slices] = min(opening.lintel_m, self.ceiling_m - 0.1)
            self.span_top[rect.slices] = self.ceiling_m
        if frame is not None:
            row = self.table.add(frame, (1.0, 2.0), self.looks[opening.first].tint)
            posts = rect.grown(0, 2) if opening.along_x else rect.grown(2, 0)
            inside = np.zeros_like(self.side[posts.slices], np.bool_)
            inside[self.solid_top[posts.slices] >= self.ceiling_m] = True
            self.side[posts.slices][inside] = row

    def _stand(self, footprint: Footprint, tint: Tint) -> None:
        part, where, mask = footprint.part, footprint.where, footprint.mask
        top_m = min(part.top_m, self.ceiling_m)
        y0, x0 = where[0].start * RESOLUTION_M, where[1].start * RESOLUTION_M
        box = Rect(where[1].start, where[0].start, where[1].stop, where[0].stop)
        height = max(top_m - part.bottom_m, 0.05)
        size = (part.width_m, height) if part.fit else (1.2, 1.2)
        side = self.table.add(part.side, size, tint, (x0, y0, part.bottom_m))
        if part.bottom_m > 0.0:
            higher = mask & (self.span_top[where] < top_m)  # one span a cell: the highest stays
            self.span_bottom[where][higher] = part.bottom_m
            self.span_top[where][higher] = top_m
            self.span[where][higher] = side
            return
        higher = mask & (self.solid_top[where] < top_m)
        self.solid_top[where][higher] = top_m
        self.side[where][higher] = side
        self.cap[where][higher] = self._fitted(part.cap, box, tint)

    def _fitted(self, texture: int, rect: Rect, tint: Tint) -> int:
        """Add a row whose texture lies once over a rectangle of floor, ceiling or top."""
        size = (rect.width * RESOLUTION_M, rect.height * RESOLUTION_M)
        return self.table.add(
            texture, size, tint, (rect.x0 * RESOLUTION_M, rect.y0 * RESOLUTION_M, 0)
        )

    def _somewhere(self, rect: Rect, size_m: tuple[float, float], margin: int) -> Rect:
        """Return a random rectangle inside a room, `margin` cells from its walls."""
        limits = rect.width - 2 * margin, rect.height - 2 * margin
        width, height = (min(to_cells(self.rng.uniform(*size_m)), limit) for limit in limits)
        x0 = rect.x0 + margin + int(self.rng.integers(limits[0] - width + 1))
        y0 = rect.y0 + margin + int(self.rng.integers(limits[1] - height + 1))
        return Rect(x0, y0, x0 + width, y0 + height)

    def _light_room(self, index: int) -> None:
        rect, look = self.layout.rooms[index].rect, self.looks[index]
        lamp = pick(self.rng, "lamp")
        for _ in range(int(self.rng.poisson(0.08 * rect.area_m2))):
            panel = self._somewhere(rect, (0.25, 1.2), 5)
            tint = np.clip(1.25 * look.tint, 0.0, 1.3)
            self.ceiling[panel.slices] = self._fitted(lamp, panel, tint)

    def _hang_pictures(self, index: int) -> None:
        """Hang pictures, boards and shelves on free stretches of wall, one cell deep."""
        rng, rect = self.rng, self.layout.rooms[index].rect
        plenty = rng.uniform(0.0, 0.6)  # some rooms stay bare
        if self.layout.rooms[index].kind == "depot":
            plenty *= 0.1
        for side, strip in enumerate(_strips(rect)):
            length = rect.height if side < 2 else rect.width
            for _ in range(int(rng.poisson(plenty * length * RESOLUTION_M))):
                width = min(to_cells(rng.uniform(0.3, 1.6)), length)
                start = int(rng.integers(length - width + 1))
                bottom = float(rng.uniform(1.12, 1.5))
                top = min(bottom + float(rng.uniform(0.35, 0.9)), self.ceiling_m - 0.1)
                if side < 2:
                    x0 = rect.x0 if side == 0 else rect.x1 - 1
                    box = Rect(x0, rect.y0 + start, x0 + 1, rect.y0 + start + width)
                    behind = (box.slices[0], strip[1])
                else:
                    y0 = rect.y0 if side == 2 else rect.y1 - 1
                    box = Rect(rect.x0 + start, y0, rect.x0 + start + width, y0 + 1)
                    behind = (strip[0], box.slices[1])
                bare = (self.solid_top[behind] >= self.ceiling_m).all()
                crowded = (self.solid_top[box.slices] > bottom - 0.05).any()
                if not bare or crowded or self.span_top[box.slices].any():
                    continue
                shown = pick(rng, "picture", "picture", "picture", "photo", "photo", "bookshelf")
                origin = (box.x0 * RESOLUTION_M, box.y0 * RESOLUTION_M, bottom)
                tint = self.looks[index].tint * rng.uniform(0.9, 1.1)
                size = (width * RESOLUTION_M, top - bottom)
                self.span[box.slices] = self.table.add(shown, size, tint, origin)
                self.span_bottom[box.slices], self.span_top[box.slices] = bottom, top


def _strips(rect: Rect) -> tuple[tuple[slice, slice], ...]:
    """Return the wall cells seen from a room: left, right, bottom, top."""
    rows, columns = rect.slices
    return (
        (rows, slice(rect.x0 - 1, rect.x0)),
        (rows, slice(rect.x1, rect.x1 + 1)),
        (slice(rect.y0 - 1, rect.y0), columns),
        (slice(rect.y1, rect.y1 + 1), columns),
    )
