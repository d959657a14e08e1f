"""A world's surface table while it grows, and the look of each room."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cbe_hil_sim.patterns import colour
from cbe_hil_sim.textures import FAMILIES
from cbe_hil_sim.world import Surfaces

Rng = np.random.Generator
Tint = NDArray[np.float64]


@dataclass(slots=True)
class SurfaceTable:
    """Rows of `Surfaces` in the order they were added."""

    textures: list[int] = field(default_factory=list)
    origins_m: list[tuple[float, float, float]] = field(default_factory=list)
    sizes_m: list[tuple[float, float]] = field(default_factory=list)
    tints: list[Tint] = field(default_factory=list)

    def add(
        self,
        texture: int,
        size_m: tuple[float, float],
        tint: Tint,
        origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> int:
        """Append a row and return its number; one texture repeat is `size_m` (width, height)."""
        self.textures.append(texture)
        self.origins_m.append(origin_m)
        self.sizes_m.append(size_m)
        self.tints.append(tint)
        return len(self.textures) - 1

    def finish(self) -> Surfaces:
        """Return the table as arrays."""
        return Surfaces(
            np.asarray(self.textures, np.int32),
            np.asarray(self.origins_m, np.float32).reshape(-1, 3),
            np.asarray(self.sizes_m, np.float32).reshape(-1, 2),
            np.asarray(self.tints, np.float32).reshape(-1, 3),
        )


def pick(rng: Rng, *families: str) -> int:
    """Return a random texture of one of the families, each family equally likely."""
    choice = FAMILIES[families[int(rng.integers(len(families)))]]
    return int(rng.integers(choice.start, choice.stop))


def light(rng: Rng) -> Tint:
    """Return a room's lighting, RGB factors: gain times a warm or cool tint."""
    warmth = rng.normal(0.0, 0.05)
    tint = np.array([1.0 + warmth, 1.0, 1.0 - warmth]) * rng.uniform(0.97, 1.03, 3)
    scaled: Tint = tint * np.clip(rng.normal(0.92, 0.14), 0.55, 1.2)
    return scaled


@dataclass(frozen=True, slots=True)
class Look:
    """What a room is covered with: texture indices (walls left, right, bottom, top) and light."""

    walls: tuple[int, int, int, int]
    wall_width_m: float
    floor: int
    floor_size_m: float
    floor_tint: Tint
    ceiling: int
    tint: Tint


_FLOORS = {
    "bath": ("tile_floor", "checker", "marble"),
    "kitchen": ("tile_floor", "wood_floor", "checker", "marble"),
    "office": ("carpet", "carpet", "wood_floor", "marble"),
    "open_office": ("carpet", "carpet", "tile_floor"),
    "meeting": ("carpet", "wood_floor"),
    "storage": ("marble", "tile_floor"),
}
_WALLS = {
    "bath": ("tiled_wall", "tiled_wall", "plaster"),
    "kitchen": ("tiled_wall", "plaster", "wallpaper"),
    "storage": ("plaster", "brick"),
}
_HOME_FLOORS = ("wood_floor", "wood_floor", "parquet", "carpet", "tile_floor")
_HOME_WALLS = ("plaster", "plaster", "plaster", "wallpaper", "wallpaper", "panelling", "panelling")
_OFFICE_WALLS = ("plaster", "plaster", "plaster", "plaster", "wallpaper", "panelling", "brick")


def draw_looks(rng: Rng, kinds: list[str], style: str) -> list[Look]:
    """Draw every room's look; some rooms share the building's wallpaper, floor or light."""
    office = style == "office"
    shared_walls = [pick(rng, *(_OFFICE_WALLS if office else _HOME_WALLS)) for _ in range(2)]
    shared_floor = pick(rng, *(("carpet", "tile_floor", "marble") if office else _HOME_FLOORS))
    shared_ceiling = pick(rng, "panel_ceiling" if office else "plain_ceiling")
    shared_light = light(rng)
    sharing, width_m = rng.uniform(0.1, 0.8), float(rng.uniform(2.4, 5.0))
    looks = []
    for kind in kinds:
        wall = pick(rng, *_WALLS.get(kind, _OFFICE_WALLS if office else _HOME_WALLS))
        if kind == "corridor" and office and rng.random() < 0.6:
            wall = pick(rng, "plaster")
        if rng.random() < sharing:
            wall = shared_walls[int(rng.integers(2))]
        walls = [wall] * 4
        if rng.random() < 0.3:
            accent = pick(rng, "mural", "brick", "panelling", "wallpaper", "plaster")
            walls[int(rng.integers(4))] = accent
        floor = shared_floor
        if kind in _FLOORS or rng.random() < 0.35:
            floor = pick(rng, *_FLOORS.get(kind, _HOME_FLOORS))
        ceiling = shared_ceiling
        if rng.random() < 0.15:
            ceiling = pick(rng, "plain_ceiling", "panel_ceiling")
        looks.append(
            Look(
                (walls[0], walls[1], walls[2], walls[3]),
                width_m if rng.random() < 0.5 else float(rng.uniform(2.0, 6.0)),
                floor,
                float(rng.uniform(1.6, 3.2)),
                np.ones(3),
                ceiling,
                shared_light if rng.random() < 0.3 else light(rng),
            )
        )
    if style in {"hall", "depot"}:
        plain = _white if rng.random() < 0.5 else _bare
        looks = [plain(rng, look) for look in looks]
    return looks


def _white(rng: Rng, look: Look) -> Look:
    """A warehouse's look: nearly white from floor to ceiling."""
    paint = colour(rng, (0.0, 0.06), (0.75, 1.0)).astype(np.float64) / 255.0
    wall, floor = pick(rng, "plain_ceiling"), pick(rng, "plain_ceiling", "plain_ceiling", "marble")
    size_m = float(rng.uniform(3.0, 20.0))
    return replace(look, walls=(wall,) * 4, floor=floor, floor_size_m=size_m, floor_tint=paint)


def _bare(rng: Rng, look: Look) -> Look:
    """A hall's look: plain paint on most floors and walls, with little to tell a step by."""
    walls = look.walls if rng.random() < 0.3 else (pick(rng, "plaster"),) * 4
    if rng.random() < 0.7:
        paint = colour(rng, (0.0, 0.35), (0.3, 1.0)).astype(np.float64) / 255.0
        floor, size_m = pick(rng, "plain_ceiling"), rng.uniform(3.0, 20.0)
    else:
        paint, floor = np.ones(3), pick(rng, "marble", "carpet", "tile_floor")
        size_m = rng.uniform(2.0, 8.0)
    return replace(look, walls=walls, floor=floor, floor_size_m=float(size_m), floor_tint=paint)
