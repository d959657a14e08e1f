"""Pieces of furniture as boxes and cylinders in a local frame, and which rooms have them.

Local frame: u along the piece's width, v from its back to its front, origin at the middle of the
footprint; z up from the floor. Lengths in metres.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cbe_hil_sim.surfacing import pick

Rng = np.random.Generator
TO_CEILING_M = math.inf


@dataclass(frozen=True, slots=True)
class Part:
    """A box or upright cylinder from `bottom_m` to `top_m`; a bottom above 0 makes it hang.

    `side` and `cap` are textures; `fit` stretches them once over the part, else they repeat.
    """

    u_m: float
    v_m: float
    width_m: float
    depth_m: float
    bottom_m: float
    top_m: float
    side: int
    cap: int
    fit: bool = False
    round: bool = False


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of furniture: its footprint and parts."""

    width_m: float
    depth_m: float
    parts: tuple[Part, ...]

    @property
    def top_m(self) -> float:
        """Height of its highest part."""
        return max(part.top_m for part in self.parts)


Factory = Callable[[Rng], Piece]


def block(
    width: tuple[float, float],
    depth: tuple[float, float],
    height: tuple[float, float],
    *sides: str,
    cap: str = "",
    round: bool = False,
) -> Factory:
    """Make pieces that are one box (or cylinder) with sizes in these ranges."""

    def make(rng: Rng) -> Piece:
        w, d = rng.uniform(*width), rng.uniform(*depth)
        if round:
            d = w
        side = pick(rng, *sides)
        top = pick(rng, cap) if cap else pick(rng, "wood", "lacquer")
        h = rng.uniform(*height) if height[1] < TO_CEILING_M else TO_CEILING_M
        return Piece(w, d, (Part(0.0, 0.0, w, d, 0.0, h, side, top, True, round),))

    return make


def _chair(u: float, v: float, back: tuple[int, int], wood: int, seat: int) -> list[Part]:
    """Four legs, a seat and a back on the side that `back` (du, dv) points to."""
    legs = [Part(u + a, v + b, 0.07, 0.07, 0.0, 0.42, wood, wood) for a, b in _corners(0.17, 0.17)]
    across = (0.07, 0.42) if back[0] else (0.42, 0.07)
    rest = Part(u + 0.18 * back[0], v + 0.18 * back[1], *across, 0.42, 0.9, seat, wood)
    return [*legs, Part(u, v, 0.42, 0.42, 0.42, 0.47, seat, seat), rest]


def _corners(u: float, v: float) -> tuple[tuple[float, float], ...]:
    return ((-u, -v), (u, -v), (-u, v), (u, v))


def _table(
    w: float, d: float, top: float, board: int, leg: int, *, round: bool = False
) -> list[Part]:
    plate = Part(0.0, 0.0, w, d, top - 0.05, top, board, board, False, round)
    if round:
        return [Part(0.0, 0.0, 0.14, 0.14, 0.0, top - 0.05, leg, leg, round=True), plate]
    feet = _corners(w / 2 - 0.06, d / 2 - 0.06)
    return [*(Part(u, v, 0.08, 0.08, 0.0, top - 0.05, leg, leg) for u, v in feet), plate]


def dining_table(rng: Rng) -> Piece:
    """Table with chairs round it."""
    board, leg, seat = pick(rng, "wood", "lacquer"), pick(rng, "wood"), pick(rng, "fabric", "wood")
    disc = bool(rng.random() < 0.3)
    w = rng.uniform(0.9, 1.2) if disc else rng.uniform(1.1, 2.2)
    d = w if disc else rng.uniform(0.75, 1.0)
    parts = _table(w, d, rng.uniform(0.7, 0.78), board, leg, round=disc)
    out = rng.uniform(0.1, 0.3)
    seats = max(1, int(w / 0.65))
    for k in range(seats):
        u = (k + 0.5) * w / seats - w / 2
        for side in (-1, 1):
            if rng.random() < 0.8:
                parts += _chair(u, side * (d / 2 + out), (0, side), leg, seat)
    return Piece(w, d + 2 * out + 0.42, tuple(parts))


def coffee_table(rng: Rng) -> Piece:
    """Low table, round or square."""
    w, disc = rng.uniform(0.6, 1.2), bool(rng.random() < 0.4)
    d = w if disc else rng.uniform(0.5, 0.8)
    board, leg = pick(rng, "wood", "lacquer", "photo"), pick(rng, "wood", "lacquer")
    return Piece(w, d, tuple(_table(w, d, rng.uniform(0.35, 0.5), board, leg, round=disc)))


def desk(rng: Rng) -> Piece:
    """Desk with drawers or legs, a screen and a chair."""
    w, d, top = rng.uniform(1.0, 1.7), rng.uniform(0.6, 0.8), rng.uniform(0.7, 0.76)
    board, leg = pick(rng, "wood", "lacquer"), pick(rng, "wood", "lacquer")
    shift = -0.28  # the chair stands in front, inside the footprint
    legs = [
        Part(u, v + shift, 0.08, 0.08, 0.0, top - 0.05, leg, leg)
        for u, v in _corners(w / 2 - 0.06, d / 2 - 0.06)
    ]
    parts = [*legs, Part(0.0, shift, w, d, top - 0.05, top, board, board)]
    if rng.random() < 0.6:
        side = rng.choice([-1.0, 1.0]) * (w / 2 - 0.22)
        front = pick(rng, "cabinet")
        parts.append(Part(side, shift, 0.4, d - 0.1, 0.0, top - 0.05, front, board, True))
    for _ in range(int(rng.integers(0, 3))):
        u = rng.uniform(-0.3, 0.3) * w
        high = rng.uniform(1.05, 1.25)
        face = pick(rng, "screen")
        parts.append(Part(u, shift - d / 2 + 0.15, 0.5, 0.07, top - 0.05, high, face, leg, True))
    u = rng.uniform(-0.25, 0.25) * w
    parts += _chair(u, d / 2 + shift + 0.3, (0, 1), leg, pick(rng, "fabric", "lacquer"))
    return Piece(w, d + 0.56, tuple(parts))


def cubicles(rng: Rng) -> Piece:
    """Two desks face to face with a screen between them."""
    w, d = rng.uniform(1.2, 1.6), 0.7
    board, leg, cloth = pick(rng, "wood", "lacquer"), pick(rng, "lacquer"), pick(rng, "fabric")
    seat, wall = pick(rng, "fabric"), rng.uniform(1.15, 1.5)
    parts = [Part(0.0, 0.0, w, 0.1, 0.0, wall, cloth, leg)]
    for side in (-1, 1):
        v = side * (0.05 + d / 2)
        parts.append(Part(0.0, v, w, d, 0.68, 0.73, board, board))
        parts += [Part(s * (w / 2 - 0.05), v, 0.1, d, 0.0, 0.68, board, board) for s in (-1, 1)]
        face = pick(rng, "screen")
        parts.append(Part(0.0, side * 0.28, 0.5, 0.07, 0.68, 1.1, face, leg, True))
        if rng.random() < 0.8:
            at = side * (0.05 + d + 0.25)
            parts += _chair(rng.uniform(-0.2, 0.2), at, (0, side), leg, seat)
    return Piece(w, 2 * (0.05 + d) + 0.95, tuple(parts))


def sofa(rng: Rng) -> Piece:
    """Seat, back and two arms; an armchair when narrow."""
    w, d, cloth = rng.uniform(0.8, 2.3), rng.uniform(0.75, 0.95), pick(rng, "fabric")
    seat, arm = rng.uniform(0.38, 0.48), rng.uniform(0.55, 0.68)
    back = rng.uniform(0.75, 0.95)
    parts = [
        Part(0.0, 0.0, w, d, 0.0, seat, cloth, cloth),
        Part(0.0, -d / 2 + 0.1, w, 0.2, 0.0, back, cloth, cloth),
    ]
    parts += [Part(s * (w / 2 - 0.08), 0.0, 0.16, d, 0.0, arm, cloth, cloth) for s in (-1, 1)]
    return Piece(w, d, tuple(parts))


def bed(rng: Rng) -> Piece:
    """Mattress with a headboard at the back, often with night tables."""
    w, d, h = rng.uniform(0.9, 1.9), rng.uniform(1.95, 2.15), rng.uniform(0.4, 0.6)
    cloth, head = pick(rng, "fabric"), pick(rng, "wood", "fabric", "lacquer")
    top = rng.uniform(0.8, 1.25)
    parts = [
        Part(0.0, 0.0, w, d, 0.0, h, cloth, pick(rng, "bedding"), True),
        Part(0.0, -d / 2 + 0.05, w, 0.1, 0.0, top, head, head, True),
    ]
    if w < 1.3 or rng.random() < 0.3:
        return Piece(w, d, tuple(parts))
    front = pick(rng, "cabinet")
    parts += [
        Part(s * (w / 2 + 0.25), -d / 2 + 0.2, 0.4, 0.4, 0.0, 0.5, front, head, True)
        for s in (-1, 1)
    ]
    return Piece(w + 0.9, d, tuple(parts))


def counter(rng: Rng) -> Piece:
    """Kitchen counter with an oven and wall cabinets above."""
    w, front = rng.uniform(1.4, 3.2), pick(rng, "cabinet")
    top = pick(rng, "marble", "wood", "lacquer")
    parts = [Part(0.0, 0.0, w, 0.6, 0.0, 0.9, front, top, True)]
    if rng.random() < 0.7:
        oven = pick(rng, "appliance")
        parts.append(Part(rng.uniform(-0.3, 0.3) * w, 0.0, 0.6, 0.65, 0.0, 0.92, oven, top, True))
    if rng.random() < 0.7:
        over = pick(rng, "cabinet", "bookshelf")
        parts.append(
            Part(0.0, -0.125, w * rng.uniform(0.5, 1.0), 0.35, 1.45, 2.15, over, over, True)
        )
    return Piece(w, 0.65, tuple(parts))


def television(rng: Rng) -> Piece:
    """Low board with a screen above."""
    w, wood = rng.uniform(1.0, 1.9), pick(rng, "wood", "lacquer")
    h = rng.uniform(0.35, 0.6)
    board = Part(0.0, 0.0, w, 0.4, 0.0, h, pick(rng, "cabinet"), wood, True)
    screen = Part(0.0, -0.1, 0.8 * w, 0.07, h + 0.08, h + 0.75, pick(rng, "screen"), wood, True)
    return Piece(w, 0.4, (board, screen))


def plant(rng: Rng) -> Piece:
    """Pot with foliage."""
    w, pot = rng.uniform(0.35, 0.75), rng.uniform(0.25, 0.45)
    leaf, clay = pick(rng, "foliage"), pick(rng, "lacquer", "marble")
    parts = (
        Part(0.0, 0.0, 0.6 * w, 0.6 * w, 0.0, pot, clay, clay, round=True),
        Part(0.0, 0.0, w, w, pot + 0.1, pot + rng.uniform(0.4, 1.4), leaf, leaf, round=True),
    )
    return Piece(w, w, parts)


def boxes(rng: Rng) -> Piece:
    """Heap of boxes of several heights."""
    w, d = rng.uniform(0.4, 1.1), rng.uniform(0.4, 0.8)
    parts = []
    for _ in range(int(rng.integers(1, 5))):
        a, b = rng.uniform(0.25, 0.5), rng.uniform(0.25, 0.4)
        u, v = rng.uniform(-0.5, 0.5) * (w - a), rng.uniform(-0.5, 0.5) * (d - b)
        face = pick(rng, "box")
        parts.append(Part(u, v, a, b, 0.0, rng.uniform(0.2, 1.2), face, face, True))
    return Piece(w, d, tuple(parts))


def shelving(rng: Rng) -> Piece:
    """Shelves on posts with boxes below and above."""
    w, d = rng.uniform(1.2, 3.0), rng.uniform(0.5, 1.1)
    steel, low = pick(rng, "lacquer"), rng.uniform(0.2, 1.3)
    gap = low + rng.uniform(0.3, 0.8)
    top = gap + rng.uniform(0.4, 1.6)
    below, above = pick(rng, "box", "bookshelf"), pick(rng, "box", "bookshelf", "photo")
    parts = [Part(0.0, 0.0, w - 0.2, d - 0.1, 0.0, low, below, below)]
    parts += [Part(0.0, 0.0, w, d, gap, top, above, above)]
    parts += [
        Part(u, v, 0.08, 0.08, 0.0, top + 0.2, steel, steel)
        for u, v in _corners(w / 2 - 0.04, d / 2 - 0.04)
    ]
    return Piece(w, d, tuple(parts))


def floor_lamp(rng: Rng) -> Piece:
    """Foot, pole and shade."""
    pole, shade = pick(rng, "lacquer"), pick(rng, "lamp", "fabric")
    parts = (
        Part(0.0, 0.0, 0.3, 0.3, 0.0, 0.04, pole, pole, round=True),
        Part(0.0, 0.0, 0.07, 0.07, 0.0, 1.35, pole, pole),
        Part(0.0, 0.0, 0.4, 0.4, 1.35, 1.7, shade, shade, True, True),
    )
    return Piece(0.4, 0.4, parts)


def window(rng: Rng) -> Piece:
    """Window, one cell proud of the wall."""
    w, bottom = rng.uniform(0.7, 2.2), rng.uniform(0.85, 1.1)
    view = pick(rng, "window")
    return Piece(
        w, 0.05, (Part(0.0, 0.0, w, 0.05, bottom, rng.uniform(1.9, 2.2), view, view, True),)
    )


closed_door = block((0.85, 1.0), (0.05, 0.05), (2.0, 2.1), "door")
cabinet = block((0.5, 1.8), (0.35, 0.55), (0.6, 1.3), "cabinet", "wood")
wardrobe = block((0.8, 2.0), (0.45, 0.65), (1.7, 2.2), "cabinet", "door", "wood")
bookcase = block((0.6, 2.0), (0.25, 0.4), (0.8, 2.1), "bookshelf")
low_shelf = block((0.5, 1.5), (0.25, 0.4), (0.3, 0.7), "bookshelf", "cabinet")
bench = block((0.8, 1.6), (0.3, 0.4), (0.4, 0.5), "wood", "fabric", cap="fabric")
radiator = block((0.6, 1.4), (0.1, 0.1), (0.5, 0.7), "appliance", "lacquer")
fridge = block((0.55, 0.75), (0.6, 0.7), (1.5, 2.0), "appliance")
washer = block((0.55, 0.65), (0.55, 0.65), (0.8, 0.95), "appliance")
bath_tub = block((1.4, 1.8), (0.65, 0.8), (0.5, 0.6), "tiled_wall", "lacquer", cap="plain_ceiling")
basin = block((0.5, 1.2), (0.4, 0.55), (0.8, 0.9), "cabinet", "plain_ceiling", cap="plain_ceiling")
toilet = block((0.38, 0.42), (0.6, 0.7), (0.4, 0.45), "plain_ceiling", cap="plain_ceiling")
copier = block((0.6, 1.1), (0.6, 0.7), (0.9, 1.2), "appliance")
rack = block((0.9, 2.2), (0.4, 0.6), (1.6, 2.1), "bookshelf", "box")
crate = block((0.3, 0.8), (0.3, 0.6), (0.25, 0.9), "box", "photo")
stool = block((0.3, 0.5), (0.3, 0.5), (0.4, 0.5), "fabric", "wood", cap="fabric", round=True)
bin_ = block((0.25, 0.35), (0.25, 0.35), (0.3, 0.65), "lacquer", round=True)
stack = block((0.7, 1.6), (0.7, 1.2), (0.6, 3.0), "box", "box", "appliance")
divider = block(
    (1.0, 3.2), (0.05, 0.15), (1.5, 2.5),
    "lacquer", "fabric", "plain_ceiling", "wood", "brick", "panelling",
)  # fmt: skip
island = block((1.2, 2.2), (0.6, 0.9), (0.88, 0.95), "cabinet", "panelling", cap="marble")
screen_wall = block((1.0, 2.0), (0.1, 0.1), (1.3, 1.9), "fabric", "mural", "photo")
column = block((0.3, 0.5), (0.3, 0.5), (0.0, TO_CEILING_M), "plaster", "marble", "brick")
round_column = block(
    (0.3, 0.5), (0.3, 0.5), (0.0, TO_CEILING_M), "plaster", "marble", "panelling", round=True
)


def high_rack(rng: Rng) -> Piece:
    """A long row of pallet racks, up to thrice as high as a person can reach."""
    w, d = rng.uniform(2.5, 12.0), rng.uniform(0.8, 1.3)
    steel, low = pick(rng, "lacquer"), rng.uniform(0.0, 1.4)
    if rng.random() < 0.4:
        low, gap = 0.0, rng.uniform(1.2, 2.6)  # one sees through below
    else:
        gap = low + rng.uniform(0.3, 1.0)
    top = gap + rng.uniform(0.3, 5.0)
    below, above = pick(rng, "box", "bookshelf"), pick(rng, "box", "bookshelf", "photo", "lacquer")
    parts = [Part(0.0, 0.0, w, d, gap, top, above, above)]
    if low > 0.3:
        parts += [Part(0.0, 0.0, w - 0.2, d - 0.1, 0.0, low, below, below)]
    bays = max(round(w / rng.uniform(1.8, 3.2)), 1)
    for bay in range(bays + 1):
        u = (bay / bays - 0.5) * (w - 0.1)
        parts += [Part(u, v, 0.1, 0.1, 0.0, top + 0.3, steel, steel) for v in (-d / 2, d / 2)]
    return Piece(w, d, tuple(parts))


@dataclass(frozen=True, slots=True)
class Set:
    """What a kind of room holds: first `wanted` pieces, then fillers at the walls and free."""

    wanted: tuple[Factory, ...]
    walls: tuple[Factory, ...]
    free: tuple[Factory, ...]
    density: float = 1.0  # scales the number of fillers
    windows: float = 0.35  # a metre of outer wall
    rows: float = 0.0  # chance that racks stand in rows


_CLUTTER = (plant, boxes, crate, stool, bin_, floor_lamp)
SETS: dict[str, Set] = {
    "living": Set(
        (sofa, television), (sofa, bookcase, cabinet, low_shelf, plant, floor_lamp, radiator),
        (coffee_table, dining_table, sofa, stool, plant, column),
    ),
    "dining": Set((), (cabinet, bookcase, bench, plant, wardrobe), (dining_table, plant)),
    "kitchen": Set(
        (counter, fridge), (counter, cabinet, fridge, washer, wardrobe, bin_),
        (island, dining_table, stool),
    ),
    "bedroom": Set(
        (bed,), (wardrobe, cabinet, desk, low_shelf, bookcase, *_CLUTTER), (stool, crate),
    ),
    "study": Set(
        (desk,), (bookcase, cabinet, sofa, plant, boxes, radiator), (coffee_table, stool),
    ),
    "bath": Set((basin, toilet), (bath_tub, washer, wardrobe, low_shelf, bin_), (), 0.7),
    "storage": Set((rack,), (rack, boxes, crate, wardrobe), (boxes, crate, rack), 1.3),
    "office": Set(
        (desk,), (desk, bookcase, cabinet, wardrobe, plant, radiator, bin_), (cubicles, plant),
    ),
    "open_office": Set(
        (), (bookcase, cabinet, copier, plant, sofa, wardrobe, screen_wall, bin_),
        (cubicles, cubicles, column, round_column, plant, screen_wall), 1.2,
    ),
    "hall": Set(
        (), (shelving, stack, rack, boxes, wardrobe, screen_wall, copier),
        (shelving, shelving, stack, divider, divider, column, round_column, crate), 0.3,
    ),
    "depot": Set(
        (), (high_rack, high_rack, shelving, stack, boxes),
        (high_rack, high_rack, high_rack, stack, crate, boxes, column, divider), 0.15, 0.03, 0.7,
    ),
    "meeting": Set(
        (), (cabinet, low_shelf, plant, television, bench), (dining_table, screen_wall),
    ),
    "corridor": Set(
        (), (low_shelf, bookcase, bench, radiator, plant, bin_, crate, copier), (), 0.45,
    ),
}  # fmt: skip
