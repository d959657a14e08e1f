"""Painters of what covers rooms: walls, floors, ceilings and rugs."""

import cv2
import numpy as np

from cbe_hil_sim.patterns import (
    SIZE,
    Floats,
    Rng,
    X,
    Y,
    colour,
    courses,
    fill,
    frame,
    grain,
    mix,
    modulate,
    noise,
    per_unit,
    wood_colour,
)

# Wall textures span floor to ceiling, so 128 rows are about 2.6 m: 2 cm a row.


def _trim(rng: Rng, wall: Floats) -> Floats:
    """Add what walls carry along their length: baseboard, wainscot, rail, moulding."""
    out = wall.copy()
    if rng.random() < 0.28:
        top = int(rng.integers(76, 92))
        lower = fill(colour(rng, (0.0, 0.5), (0.3, 0.95)))
        if rng.random() < 0.5:
            panels = (X * int(rng.integers(4, 14))) % 1.0
            lower = modulate(lower, (panels < 0.06).astype(np.float32), -0.3)
        out[top:] = modulate(lower, noise(rng), 0.02)[top:]
        out[top : top + 2] *= 0.72
    if rng.random() < 0.15:
        band = int(rng.integers(6, 22))
        height = int(rng.integers(4, 9))
        out[band : band + height] = colour(rng, (0.2, 0.7), (0.3, 0.9))
    if rng.random() < 0.85:
        height = int(rng.integers(3, 7))
        board = rng.choice(3)
        tone = (np.full(3, 235.0), wood_colour(rng), colour(rng, (0.0, 0.3), (0.15, 0.7)))[board]
        out[-height:] = tone
        out[-height] *= 0.75
    out *= np.linspace(1.03, 0.95, SIZE, dtype=np.float32)[:, None, None]  # light comes from above
    return out


def plaster(rng: Rng) -> Floats:
    """Nearly plain paint, often white."""
    white = rng.random() < 0.45
    base = (
        colour(rng, (0.0, 0.05), (0.82, 0.95)) if white else colour(rng, (0.08, 0.5), (0.5, 0.92))
    )
    wall = modulate(fill(base), noise(rng, 2.0), rng.uniform(0.004, 0.03))
    return _trim(rng, modulate(wall, noise(rng, 0.3), rng.uniform(0.0, 0.02)))


def wallpaper(rng: Rng) -> Floats:
    """Stripes, dots, diamonds, waves or stamped motifs, unevenly faded along the wall."""
    ground = colour(rng, (0.05, 0.45), (0.5, 0.92))
    ink = ground * rng.uniform(0.55, 0.8) if rng.random() < 0.5 else colour(rng, (0.2, 0.7))
    kind = int(rng.integers(5))
    n = int(rng.integers(6, 18))
    if kind == 0:
        duty = rng.uniform(0.2, 0.6)
        phase = (X * n) % 1.0
        weight = (phase < duty).astype(np.float32)
        weight += 0.5 * (np.abs(phase - 0.8) < 0.06)
    elif kind == 1:
        u, v = (X * n) % 1.0 - 0.5, (Y * n + 0.5 * (np.floor(X * n) % 2)) % 1.0 - 0.5
        weight = (np.hypot(u, v) < rng.uniform(0.15, 0.35)).astype(np.float32)
    elif kind == 2:
        weight = 0.5 + 0.5 * np.sin(2 * np.pi * n * X) * np.sin(2 * np.pi * n * Y) * 2.0
    elif kind == 3:
        wave = Y * n + 0.35 * np.sin(2 * np.pi * X * int(rng.integers(2, 6)))
        weight = ((wave % 1.0) < 0.4).astype(np.float32)
    else:
        tile = 128 // int(rng.choice([4, 8]))
        stamp = cv2.resize((noise(rng, 1.6)[:32, :16] > 0.2).astype(np.float32), (tile // 2, tile))
        motif = np.hstack([stamp, stamp[:, ::-1]])
        weight = np.tile(motif, (SIZE // tile, SIZE // tile)).astype(np.float32)
    wall = mix(ground, ink, weight * np.float32(rng.uniform(0.4, 1.0)))
    return _trim(rng, modulate(wall, noise(rng, 2.0), 0.03))


def brick(rng: Rng) -> Floats:
    """Brickwork, bare or painted."""
    rows = int(rng.choice([16, 20, 24]))
    joints, unit = courses(rows // 4, rows, 0.5, 0.14)
    base = colour(rng, (0.3, 0.65), (0.4, 0.75), (0.0, 0.07))
    if rng.random() < 0.35:
        base = colour(rng, (0.0, 0.2), (0.6, 0.9))
    wall = modulate(fill(base), per_unit(rng, unit, 0.14) + 0.08 * noise(rng, 0.6), 1.0)
    wall[joints] = colour(rng, (0.0, 0.1), (0.5, 0.8))
    return modulate(wall, noise(rng, 2.0), 0.05)


def panelling(rng: Rng) -> Floats:
    """Vertical boards or framed panels."""
    base = wood_colour(rng) if rng.random() < 0.65 else colour(rng, (0.05, 0.4), (0.35, 0.9))
    wall = np.ascontiguousarray(grain(rng, base, 0.1).transpose(1, 0, 2))
    n = int(rng.integers(3, 16))
    board = np.floor(X * n).astype(np.intp)
    wall = modulate(wall, per_unit(rng, board, 0.08), 1.0)
    wall[((X * n) % 1.0) < 0.06] *= 0.6
    if rng.random() < 0.5:
        for row in rng.choice([20, 44, 76, 100], 2, replace=False):
            wall[row : row + 2] *= 0.65
    return _trim(rng, wall)


def mural(rng: Rng) -> Floats:
    """Large shapes over the whole wall: an accent wall that tells one spot from another."""
    first, second, third = (colour(rng, (0.1, 0.6), (0.35, 0.92)) for _ in range(3))
    kind = int(rng.integers(4))
    if kind == 0:
        steps = np.round(noise(rng, 2.2) * rng.uniform(1.0, 2.0)) / 2.0
        wall = mix(mix(first, second, steps + 0.5), third, steps - 0.7)
    elif kind == 1:
        wall = fill(first)
        for _ in range(int(rng.integers(5, 14))):
            centre = (int(rng.integers(SIZE)), int(rng.integers(20, 100)))
            radius = int(rng.integers(4, 20))
            tone = tuple(float(c) for c in (second, third)[int(rng.integers(2))])
            for offset in (-SIZE, 0, SIZE):
                spot = (centre[0] + offset, centre[1])
                cv2.circle(wall, spot, radius, tone, -1)
    elif kind == 2:
        edges = np.sort(rng.uniform(0.0, 1.0, int(rng.integers(3, 8))))
        tones = np.stack([colour(rng, (0.1, 0.5), (0.4, 0.92)) for _ in range(len(edges) + 1)])
        wall = tones[np.searchsorted(edges, X)].astype(np.float32)
    else:
        slant = (X + Y * rng.choice([-1.0, 1.0]) + 0.15 * noise(rng, 2.5)) % 1.0
        wall = mix(mix(first, second, (slant - 0.3) * 12), third, (slant - 0.7) * 12)
    return _trim(rng, modulate(wall, noise(rng, 1.2), 0.03))


def tiled_wall(rng: Rng) -> Floats:
    """Bathroom or kitchen tiles, to the ceiling or to half height."""
    n = int(rng.choice([8, 12, 16]))
    joints, unit = courses(n, n, float(rng.choice([0.0, 0.5])), 0.1)
    base = colour(rng, (0.0, 0.4), (0.6, 0.95))
    tiles = modulate(fill(base), per_unit(rng, unit, rng.uniform(0.01, 0.07)), 1.0)
    accent = rng.random(int(unit.max()) + 1) < rng.choice([0.0, 0.05, 0.2])
    tiles[accent[unit]] = colour(rng, (0.2, 0.7), (0.3, 0.8))
    tiles[joints] = colour(rng, (0.0, 0.1), (0.55, 0.85))
    if rng.random() < 0.4:
        top = int(rng.integers(40, 70))
        tiles[:top] = colour(rng, (0.0, 0.15), (0.8, 0.95))
        tiles[top : top + 3] = colour(rng, (0.2, 0.7), (0.3, 0.7))
    return tiles


def wood_floor(rng: Rng) -> Floats:
    """Planks laid along x, their ends staggered."""
    rows, columns = int(rng.choice([8, 12, 16])), int(rng.integers(1, 4))
    joints, unit = courses(columns, rows, rng.uniform(0.3, 0.5), 0.07)
    floor = grain(rng, wood_colour(rng, (0.35, 0.85)), 0.07)
    floor = modulate(floor, per_unit(rng, unit, rng.uniform(0.05, 0.14)), 1.0)
    floor[joints] *= 0.7
    return floor if rng.random() < 0.5 else np.ascontiguousarray(floor.transpose(1, 0, 2))


def parquet(rng: Rng) -> Floats:
    """Basket-weave blocks of short planks."""
    n = int(rng.choice([4, 6, 8]))
    base = wood_colour(rng, (0.35, 0.8))
    block = (np.floor(X * n) + np.floor(Y * n)) % 2 == 0
    strip = np.where(block, np.floor(X * n * 4), np.floor(Y * n * 4))
    unit = (strip + 4 * n * (np.floor(Y * n) * n + np.floor(X * n))).astype(np.intp)
    floor = modulate(fill(base), per_unit(rng, unit, 0.1) + 0.06 * noise(rng, 0.5), 1.0)
    return modulate(floor, np.where(block, 1.0, -1.0).astype(np.float32), 0.05)


def tile_floor(rng: Rng) -> Floats:
    """Square tiles with grout."""
    n = int(rng.choice([3, 4, 6, 8]))
    joints, unit = courses(n, n, 0.0, 0.05)
    floor = modulate(fill(colour(rng, (0.0, 0.4), (0.4, 0.9))), per_unit(rng, unit, 0.05), 1.0)
    floor = modulate(floor, noise(rng, 1.2), rng.uniform(0.01, 0.06))
    floor[joints] = colour(rng, (0.0, 0.15), (0.3, 0.75))
    return floor


def checker(rng: Rng) -> Floats:
    """Two-tone checkerboard."""
    n = int(rng.choice([4, 6, 8]))
    dark = ((np.floor(X * n) + np.floor(Y * n)) % 2).astype(np.float32)
    light, other = colour(rng, (0.0, 0.25), (0.7, 0.95)), colour(rng, (0.0, 0.6), (0.12, 0.6))
    return modulate(mix(light, other, dark), noise(rng, 1.3), 0.04)


def carpet(rng: Rng) -> Floats:
    """Fitted carpet, flecked or in office squares."""
    floor = modulate(fill(colour(rng, (0.05, 0.5), (0.25, 0.7))), noise(rng, 0.2), 0.08)
    floor = modulate(floor, noise(rng, 1.8), 0.05)
    if rng.random() < 0.4:
        n = int(rng.choice([4, 6]))
        _, unit = courses(n, n)
        floor = modulate(floor, per_unit(rng, unit, 0.09), 1.0)
    return floor


def marble(rng: Rng) -> Floats:
    """Veined stone or polished concrete."""
    veins = 1.0 - np.abs(np.sin(2.5 * noise(rng, 1.7)))
    base = colour(rng, (0.0, 0.2), (0.45, 0.92))
    dark = base * np.float32(rng.uniform(0.5, 0.9))
    return modulate(mix(base, dark, veins**2), noise(rng, 1.5), 0.04)


def plain_ceiling(rng: Rng) -> Floats:
    """White or off-white paint."""
    base = colour(rng, (0.0, 0.08), (0.8, 0.97))
    return modulate(fill(base), noise(rng, 1.5), rng.uniform(0.004, 0.03))


def panel_ceiling(rng: Rng) -> Floats:
    """Suspended panels or wooden boards; some panels are lights or vents."""
    if rng.random() < 0.25:
        joints, unit = courses(1, int(rng.choice([8, 12])), 0.0, 0.08)
        boards = modulate(
            grain(rng, wood_colour(rng, (0.5, 0.9)), 0.06), per_unit(rng, unit, 0.05), 1
        )
        boards[joints] *= 0.7
        return boards
    joints, unit = courses(4, 4, 0.0, 0.05)
    panels = modulate(fill(colour(rng, (0.0, 0.06), (0.7, 0.88))), noise(rng, 0.2), 0.03)
    kinds = rng.random(16)
    panels[(kinds < 0.1)[unit]] = 252.0
    panels[(kinds > 0.93)[unit]] *= 0.55
    panels[joints] = colour(rng, (0.0, 0.05), (0.5, 0.95))
    return panels


def lamp(rng: Rng) -> Floats:
    """Ceiling light with a rim and slats."""
    light = fill(colour(rng, (0.0, 0.12), (0.97, 1.0)))
    slats = ((X * int(rng.integers(2, 9))) % 1.0 < 0.12).astype(np.float32)
    return frame(
        modulate(light, slats, -0.25), int(rng.integers(4, 10)), np.full(3, 170, np.float32)
    )


def rug(rng: Rng) -> Floats:
    """Bordered rug with a field pattern or medallion."""
    first, second, third = (colour(rng, (0.2, 0.75), (0.2, 0.8)) for _ in range(3))
    ring = np.maximum(np.abs(X - 0.5), np.abs(Y - 0.5)) * 2.0
    field = np.abs(X - 0.5) + np.abs(Y - 0.5) if rng.random() < 0.5 else np.hypot(X - 0.5, Y - 0.5)
    image = mix(first, second, (np.sin(field * rng.uniform(10, 40)) > 0).astype(np.float32))
    if rng.random() < 0.4:
        image = mix(first, third, (noise(rng, 2.0) > 0.3).astype(np.float32))
    image = mix(image, fill(third), (ring > rng.uniform(0.7, 0.85)).astype(np.float32))
    image = mix(image, fill(first), (np.abs(ring - 0.9) < 0.025).astype(np.float32))
    return modulate(image, noise(rng, 0.2), 0.06)
