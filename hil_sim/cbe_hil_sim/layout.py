"""Floor layouts: rooms and corridors split from a rectangle, joined by doors and openings.

Lengths without a unit are grid cells (0.05 m); rectangles are half-open.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from cbe_hil_sim.world import RESOLUTION_M

Rng = np.random.Generator
OUTER_WALL = 5
SMALLEST_M2 = 90.0  # of floor: 100 m2 with its walls


def to_cells(length_m: float) -> int:
    """Nearest whole number of cells."""
    return round(length_m / RESOLUTION_M)


@dataclass(frozen=True, slots=True)
class Rect:
    """Cells x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        """Extent along x."""
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        """Extent along y."""
        return self.y1 - self.y0

    @property
    def area_m2(self) -> float:
        """Area in square metres."""
        return self.width * self.height * RESOLUTION_M**2

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of a (y, x) grid."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def grown(self, dx: int, dy: int) -> "Rect":
        """Return the rectangle moved outward by dx and dy on both sides, kept at 0 or above."""
        return Rect(max(self.x0 - dx, 0), max(self.y0 - dy, 0), self.x1 + dx, self.y1 + dy)


@dataclass(frozen=True, slots=True)
class Room:
    """A rectangular room and what it is used for, e.g. "bedroom" or "corridor"."""

    rect: Rect
    kind: str


@dataclass(frozen=True, slots=True)
class Opening:
    """A gap in the wall between rooms `first` and `second` (left or below comes first).

    `along_x`: one walks through it along x. `lintel_m` is the lower edge of what hangs over it,
    0 where it reaches the ceiling.
    """

    first: int
    second: int
    rect: Rect
    along_x: bool
    lintel_m: float

    @property
    def width(self) -> int:
        """Cells from jamb to jamb."""
        return self.rect.height if self.along_x else self.rect.width


@dataclass(frozen=True, slots=True)
class Layout:
    """Rooms and openings on a (rows, columns) grid; everything else is wall."""

    style: str
    shape: tuple[int, int]
    rooms: tuple[Room, ...]
    openings: tuple[Opening, ...]


@dataclass(frozen=True, slots=True)
class Style:
    """How one kind of building is divided; ranges in m, m2."""

    name: str
    area_m2: tuple[float, float]
    room_m2: tuple[float, float]
    shortest_side_m: float
    corridor_m: tuple[float, float]
    corridor_levels: int
    corridor_chance: float
    wide_chance: float
    extra_doors: float
    kinds: tuple[str, ...]  # of rooms, largest first, then repeated from `kinds[repeat:]`
    repeat: int


STYLES = (
    Style(
        "house", (100.0, 300.0), (10.0, 34.0), 2.5, (1.1, 1.8), 1, 0.6, 0.3, 0.35,
        (
            "living", "kitchen", "dining", "bedroom", "bedroom", "study", "bath", "bedroom",
            "storage",
        ), 2,
    ),
    Style(
        "apartment", (100.0, 160.0), (9.0, 28.0), 2.3, (1.1, 1.6), 1, 0.8, 0.25, 0.2,
        ("living", "kitchen", "bedroom", "bedroom", "bath", "study", "storage"), 2,
    ),
    Style(
        "office", (200.0, 600.0), (12.0, 70.0), 2.8, (1.4, 2.4), 2, 0.85, 0.12, 0.25,
        ("open_office", "meeting", "office", "office", "office", "kitchen", "storage"), 0,
    ),
)  # fmt: skip
HALL = Style(
    "hall", (200.0, 700.0), (50.0, 320.0), 5.0, (1.6, 3.0), 1, 0.5, 0.5, 0.4,
    ("hall", "hall", "storage", "hall"), 0,
)  # fmt: skip
"""Workshops, storerooms and open floors."""
DEPOT = Style(
    "depot",
    (150.0, 800.0),
    (150.0, 1600.0),
    6.0,
    (2.0, 4.0),
    1,
    0.1,
    0.8,
    0.4,
    ("depot",),
    0,
)
"""Warehouses of mostly one room."""


def _divide(rng: Rng, rect: Rect, style: Style, levels: int, rooms: list[Room]) -> None:
    """Split `rect` until its parts are rooms; `levels` is how many corridors may still follow."""
    wall = int(rng.integers(2, 6))
    shortest = to_cells(style.shortest_side_m)
    along_x = rect.width >= rect.height  # the longer side is cut
    short, long = sorted((rect.width, rect.height))
    corridor = to_cells(rng.uniform(*style.corridor_m))
    fits = short >= 2 * shortest + corridor + 2 * wall and long >= to_cells(6.0)
    if levels > 0 and fits and rng.random() < style.corridor_chance:
        spare = short - 2 * shortest - corridor - 2 * wall
        first = shortest + int(rng.uniform(0.25, 0.75) * spare)
        start, end = first + wall, first + wall + corridor
        if along_x:
            low = Rect(rect.x0, rect.y0, rect.x1, rect.y0 + first)
            hall = Rect(rect.x0, rect.y0 + start, rect.x1, rect.y0 + end)
            high = Rect(rect.x0, rect.y0 + end + wall, rect.x1, rect.y1)
        else:
            low = Rect(rect.x0, rect.y0, rect.x0 + first, rect.y1)
            hall = Rect(rect.x0 + start, rect.y0, rect.x0 + end, rect.y1)
            high = Rect(rect.x0 + end + wall, rect.y0, rect.x1, rect.y1)
        rooms.append(Room(hall, "corridor"))
        _divide(rng, low, style, levels - 1, rooms)
        _divide(rng, high, style, levels - 1, rooms)
        return
    low_m2, high_m2 = style.room_m2
    target_m2 = low_m2 * (high_m2 / low_m2) ** rng.random()
    if rect.area_m2 <= target_m2 or long < 2 * shortest + wall:
        rooms.append(Room(rect, ""))
        return
    cut = shortest + int(rng.uniform(0.15, 0.85) * (long - 2 * shortest - wall))
    if along_x:
        low = Rect(rect.x0, rect.y0, rect.x0 + cut, rect.y1)
        high = Rect(rect.x0 + cut + wall, rect.y0, rect.x1, rect.y1)
    else:
        low = Rect(rect.x0, rect.y0, rect.x1, rect.y0 + cut)
        high = Rect(rect.x0, rect.y0 + cut + wall, rect.x1, rect.y1)
    _divide(rng, low, style, levels, rooms)
    _divide(rng, high, style, levels, rooms)


@dataclass(frozen=True, slots=True)
class _Border:
    """A wall shared by two rooms: the gap across it and the overlap along it."""

    first: int
    second: int
    along_x: bool
    gap: tuple[int, int]
    overlap: tuple[int, int]


JAMB = 4  # cells of wall kept beside a door
NARROWEST = 16 + 2 * JAMB


def _borders(rooms: list[Room]) -> list[_Border]:
    """Pairs of rooms whose shared wall has space for a door."""
    borders = []
    for i, a in enumerate(rooms):
        for j, b in enumerate(rooms):
            p, q = a.rect, b.rect
            rows, columns = (max(p.y0, q.y0), min(p.y1, q.y1)), (max(p.x0, q.x0), min(p.x1, q.x1))
            if 0 < q.x0 - p.x1 <= 5 and rows[1] - rows[0] >= NARROWEST:
                borders.append(_Border(i, j, True, (p.x1, q.x0), rows))
            if 0 < q.y0 - p.y1 <= 5 and columns[1] - columns[0] >= NARROWEST:
                borders.append(_Border(i, j, False, (p.y1, q.y0), columns))
    return borders


def _opening(rng: Rng, border: _Border, wide_chance: float) -> Opening:
    space = border.overlap[1] - border.overlap[0] - 2 * JAMB
    width, lintel_m = int(rng.integers(16, 21)), float(rng.uniform(2.0, 2.1))
    if space >= 24 and rng.random() < wide_chance:
        width = int(rng.integers(24, min(space, 60) + 1))
        lintel_m = 0.0 if rng.random() < 0.35 else float(rng.uniform(2.05, 2.2))
    width = min(width, space)
    # Doors are mostly near an end of a wall, as in homes; else anywhere.
    slack = space - width
    offset = int(slack * rng.beta(0.6, 0.6))
    start = border.overlap[0] + JAMB + offset
    if border.along_x:
        rect = Rect(border.gap[0], start, border.gap[1], start + width)
    else:
        rect = Rect(start, border.gap[0], start + width, border.gap[1])
    return Opening(border.first, border.second, rect, border.along_x, lintel_m)


def _label(rooms: list[Room], borders: list[_Border]) -> np.ndarray:
    rows, columns = [b.first for b in borders], [b.second for b in borders]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(rooms), len(rooms)))
    return np.asarray(connected_components(graph, directed=False)[1])


def _without_corner(rng: Rng, rooms: list[Room], rect: Rect) -> list[Room]:
    """Leave out one corner room where the rest stays joined: an L-shaped plan."""
    corners = [
        room
        for room in rooms
        if room.kind != "corridor"
        and (room.rect.x0 == rect.x0 or room.rect.x1 == rect.x1)
        and (room.rect.y0 == rect.y0 or room.rect.y1 == rect.y1)
    ]
    if not corners:
        return rooms
    dropped = corners[int(rng.integers(len(corners)))]
    kept = [room for room in rooms if room is not dropped]
    joined = bool(kept) and _label(kept, _borders(kept)).max() == 0
    return kept if joined and sum(r.rect.area_m2 for r in kept) >= SMALLEST_M2 else rooms


def _name_kinds(rng: Rng, rooms: list[Room], style: Style) -> list[Room]:
    order = sorted(
        (k for k, room in enumerate(rooms) if room.kind != "corridor"),
        key=lambda k: -rooms[k].rect.area_m2 * rng.uniform(0.6, 1.4),
    )
    kinds = list(style.kinds)
    while len(kinds) < len(order):
        kinds += style.kinds[style.repeat :]
    named = list(rooms)
    for k, kind in zip(order, kinds, strict=False):
        named[k] = Room(rooms[k].rect, kind)
    return named


def draw_layout(rng: Rng, style: Style | None = None) -> Layout:
    """Draw rooms of a style, else a house, an apartment or an office of 100 to 600 m2.

    Every room can be reached.
    """
    style = style or STYLES[int(rng.choice(len(STYLES), p=(0.45, 0.2, 0.35)))]
    area_m2 = rng.uniform(*style.area_m2)
    ratio = rng.uniform(1.0, 1.9)
    sides = to_cells((area_m2 * ratio) ** 0.5), to_cells((area_m2 / ratio) ** 0.5)
    width, height = sides if rng.random() < 0.5 else sides[::-1]
    rect = Rect(OUTER_WALL, OUTER_WALL, OUTER_WALL + width, OUTER_WALL + height)
    rooms: list[Room] = []
    _divide(rng, rect, style, style.corridor_levels, rooms)
    if rng.random() < 0.35:
        rooms = _without_corner(rng, rooms, rect)
    labels = _label(rooms, _borders(rooms))
    main = np.argmax(np.bincount(labels))
    rooms = _name_kinds(rng, [r for r, k in zip(rooms, labels, strict=True) if k == main], style)
    borders = _borders(rooms)
    halls = ["corridor" in (rooms[b.first].kind, rooms[b.second].kind) for b in borders]
    weight = rng.uniform(0.2, 1.0, len(borders)) - 0.15 * np.asarray(halls)  # prefer the corridor
    index = ([b.first for b in borders], [b.second for b in borders])
    tree = minimum_spanning_tree(coo_array((weight, index), shape=(len(rooms), len(rooms))).tocsr())
    joined = set(zip(*tree.nonzero(), strict=True))
    social = {"living", "kitchen", "dining", "open_office", "corridor"}
    openings = []
    for border in borders:
        if (border.first, border.second) not in joined and rng.random() >= style.extra_doors:
            continue
        open_plan = {rooms[border.first].kind, rooms[border.second].kind} <= social
        openings.append(_opening(rng, border, style.wide_chance * (2.0 if open_plan else 0.4)))
    shape = (height + 2 * OUTER_WALL, width + 2 * OUTER_WALL)
    return Layout(style.name, shape, tuple(rooms), tuple(openings))
