"""Painters of what stands or hangs in rooms: furniture faces, doors, windows, pictures, plants."""

from functools import cache
from importlib import resources

import cv2
import numpy as np

from cbe.errors import WorldError
from cbe_hil_sim.patterns import (
    SIZE,
    Floats,
    Rng,
    X,
    Y,
    colour,
    fill,
    frame,
    grain,
    mix,
    modulate,
    noise,
    wood_colour,
)

PHOTOS = (
    "brick", "camera", "chelsea", "clock", "coffee", "grass", "gravel", "hubble", "retina", "rocket"
)  # fmt: skip


def _tone(rng: Rng, saturation: tuple[float, float] = (0.1, 0.8)) -> tuple[float, ...]:
    return tuple(float(c) for c in colour(rng, saturation, (0.1, 0.95)))


def _body(rng: Rng) -> Floats:
    """Return a furniture carcass: wood, lacquer or paint."""
    if rng.random() < 0.55:
        return grain(rng, wood_colour(rng, (0.25, 0.9)), 0.1)
    return modulate(fill(colour(rng, (0.0, 0.6), (0.2, 0.95))), noise(rng), 0.02)


def wood(rng: Rng) -> Floats:
    """Plain veneer for table tops, legs and carcasses."""
    return grain(rng, wood_colour(rng, (0.2, 0.9)), rng.uniform(0.05, 0.14))


def lacquer(rng: Rng) -> Floats:
    """Plain painted board, plastic or brushed metal."""
    image = modulate(fill(colour(rng, (0.0, 0.7), (0.12, 0.95))), noise(rng, 1.8), 0.03)
    return modulate(image, noise(rng, 0.6, along_y=0.05), rng.uniform(0.0, 0.04))


def fabric(rng: Rng) -> Floats:
    """Upholstery: weave, stripes, tartan or cushions' seams."""
    base, other = colour(rng, (0.05, 0.7), (0.2, 0.85)), colour(rng, (0.1, 0.7), (0.2, 0.9))
    image = modulate(fill(base), noise(rng, 0.2), 0.06)
    kind, n = int(rng.integers(4)), int(rng.integers(3, 12))
    if kind == 0:
        image = mix(image, other, 0.6 * ((X * n) % 1.0 < 0.3))
    elif kind == 1:
        image = mix(image, other, 0.35 * ((X * n) % 1.0 < 0.4) + 0.35 * ((Y * n) % 1.0 < 0.4))
    elif kind == 2:
        seams = int(rng.integers(2, 4))
        image = modulate(image, ((X * seams) % 1.0 < 0.04).astype(np.float32), -0.4)
        image = modulate(image, np.sin(np.pi * ((X * seams) % 1.0)).astype(np.float32), 0.12)
    return modulate(image, noise(rng, 1.8), 0.05)


def bedding(rng: Rng) -> Floats:
    """Bed seen from above: blanket below, pillows on top."""
    blanket = fabric(rng)
    sheet = colour(rng, (0.0, 0.15), (0.8, 0.96))
    blanket[:40] = sheet
    for left in (8, 68) if rng.random() < 0.7 else (28,):
        cv2.rectangle(blanket, (left, 6), (left + 52, 32), _tone(rng, (0.0, 0.6)), -1)
        cv2.rectangle(blanket, (left, 6), (left + 52, 32), (150.0, 150.0, 150.0), 1)
    blanket[40:44] *= 0.8
    return modulate(blanket, noise(rng, 1.8), 0.05)


def cabinet(rng: Rng) -> Floats:
    """Front of a cabinet or chest: doors and drawers with handles."""
    image = _body(rng)
    columns, rows = int(rng.integers(1, 5)), int(rng.integers(1, 6))
    u, v = (X * columns) % 1.0, (Y * rows) % 1.0
    seam = (u < 0.03 * columns) | (v < 0.03 * rows)
    if rng.random() < 0.4:  # framed panels
        du, dv = np.minimum(u, 1.0 - u), np.minimum(v, 1.0 - v)
        image = modulate(image, ((du > 0.16) & (dv > 0.2)).astype(np.float32), -0.15)
    if rng.random() < 0.3:  # two-tone doors
        doors = (np.floor(X * columns) + np.floor(Y * rows)) % 2
        image = mix(image, colour(rng, (0.0, 0.7), (0.3, 0.95)), 0.85 * doors.astype(np.float32))
    image[seam] *= 0.45
    handle = _tone(rng, (0.0, 0.4))
    wide = rng.random() < 0.5
    size = (0.16, 0.05) if wide else (0.05, 0.22)
    at_u, at_v = (0.5, 0.25) if wide else (0.82, 0.5)
    knob = (np.abs(u - at_u) < size[0]) & (np.abs(v - at_v) < size[1] * min(rows, 3))
    image[knob] = handle
    return image


def bookshelf(rng: Rng) -> Floats:
    """Rows of book spines with gaps and a few objects."""
    image = _body(rng) * np.float32(0.45)
    rows = int(rng.integers(3, 7))
    height = SIZE // rows
    palette = [_tone(rng) for _ in range(int(rng.integers(3, 9)))]
    for row in range(rows):
        floor = (row + 1) * height - 3
        x = 4
        while x < SIZE - 8:
            if rng.random() < 0.12:
                x += int(rng.integers(5, 24))
                continue
            width = int(rng.integers(3, 9)) if rng.random() < 0.85 else int(rng.integers(10, 22))
            top = floor - int(rng.uniform(0.55, 0.92) * (height - 4))
            tone = palette[int(rng.integers(len(palette)))]
            cv2.rectangle(image, (x, top), (min(x + width - 1, SIZE - 5), floor), tone, -1)
            x += width
        image[floor : floor + 4] = image[0, 0] * 2.0
    image[:, :4] = image[:, -4:] = image[0, 0]
    return modulate(image, noise(rng, 1.2), 0.04)


def door(rng: Rng) -> Floats:
    """Door leaf with frame, panels or glass, and handle."""
    image = np.ascontiguousarray(_body(rng).transpose(1, 0, 2))
    kind = int(rng.integers(4))
    if kind == 1:
        for top, bottom in ((10, 54), (64, 118)):
            for left, right in ((16, 58), (70, 112)):
                cv2.rectangle(image, (left, top), (right, bottom), _tone(rng, (0.0, 0.3)), 2)
                image[top + 3 : bottom - 2, left + 3 : right - 2] *= 0.88
    elif kind == 2:
        image[14 : int(rng.integers(50, 110)), 28:100] = _tone(rng, (0.05, 0.3))
    elif kind == 3:
        sign = _tone(rng)
        cv2.rectangle(image, (44, 22), (84, 38), sign, -1)
    cv2.rectangle(image, (108, 64), (120, 68), (60.0, 60.0, 60.0), -1)
    return frame(image, 6, np.asarray(_tone(rng, (0.0, 0.3)), np.float32))


def _landscape(rng: Rng) -> Floats:
    """Sky, hills and houses or trees."""
    sky = colour(rng, (0.1, 0.5), (0.8, 1.0), (0.5, 0.65))
    image = mix(sky, np.full(3, 245, np.float32), Y * rng.uniform(0.5, 1.5))
    image = mix(image, np.full(3, 250, np.float32), 0.8 * (noise(rng, 2.0) - 0.6))
    line = np.float32(rng.uniform(0.35, 0.7))
    for _ in range(int(rng.integers(1, 4))):
        ridge = line + 0.06 * noise(rng, 1.6)[0][None, :]
        green = colour(rng, (0.2, 0.6), (0.15, 0.6), (0.15, 0.45))
        image = mix(image, green, ((ridge < Y) * 1.0).astype(np.float32))
        line += np.float32(rng.uniform(0.05, 0.2))
    for _ in range(int(rng.integers(0, 5))):
        left, width = int(rng.integers(-10, 110)), int(rng.integers(14, 44))
        top = int(rng.integers(20, 80))
        cv2.rectangle(image, (left, top), (left + width, SIZE), _tone(rng, (0.0, 0.4)), -1)
        pane = _tone(rng, (0.0, 0.3))
        for y in range(top + 5, SIZE, 11):
            for x in range(left + 3, left + width - 4, 8):
                cv2.rectangle(image, (x, y), (x + 3, y + 5), pane, -1)
    return image


def window(rng: Rng) -> Floats:
    """Window with a view, bars and sometimes curtains or blinds."""
    image = _landscape(rng) * np.float32(rng.uniform(0.85, 1.25))
    bars = int(rng.integers(1, 4))
    tone = np.asarray(_tone(rng, (0.0, 0.25)) if rng.random() < 0.3 else (240.0,) * 3, np.float32)
    image[((X * bars + 0.5 / SIZE) % 1.0) < 0.05 * bars] = tone
    if rng.random() < 0.5:
        row = int(rng.integers(30, 80))
        image[row : row + 5] = tone
    cover = rng.random()
    if cover < 0.4:
        cloth = modulate(fabric(rng), np.sin(X * 150.0), 0.14)
        width = rng.uniform(0.12, 0.3)
        closed = np.abs(X - 0.5) > 0.5 - width
        image[closed] = cloth[closed]
    elif cover < 0.6:
        slats = fill(colour(rng, (0.0, 0.3), (0.6, 0.95)))
        slats = modulate(slats, ((Y * 20) % 1.0 < 0.3).astype(np.float32), -0.3)
        down = int(rng.integers(20, 120))
        image[:down] = slats[:down]
    return frame(np.ascontiguousarray(image, np.float32), 6, tone)


def _shapes(rng: Rng) -> Floats:
    """Abstract composition of discs, polygons and strokes."""
    image = mix(colour(rng), colour(rng), (X + Y) / 2 if rng.random() < 0.5 else Y)
    for _ in range(int(rng.integers(3, 12))):
        tone = _tone(rng)
        points = rng.integers(-10, SIZE + 10, (int(rng.integers(3, 6)), 2)).astype(np.int32)
        kind = int(rng.integers(4))
        if kind == 0:
            centre = (int(points[0, 0]), int(points[0, 1]))
            cv2.circle(image, centre, int(rng.integers(6, 40)), tone, -1)
        elif kind == 1:
            cv2.fillPoly(image, [points[:, None]], tone)
        elif kind == 2:
            cv2.polylines(image, [points[:, None]], False, tone, int(rng.integers(2, 12)))
        else:
            start = (int(points[0, 0]), int(points[0, 1]))
            end = (int(points[1, 0]), int(points[1, 1]))
            cv2.rectangle(image, start, end, tone, -1)
    return image


def _poster(rng: Rng) -> Floats:
    """Lines of large text, blocks and a chart, as offices have."""
    page = fill(colour(rng, (0.0, 0.8), (0.3, 0.98))).astype(np.uint8)  # putText wants bytes
    letters = "ABCDEFGHKLMNPRSTUVXYZ23456789"
    ink = _tone(rng)
    y = int(rng.integers(24, 44))
    while y < SIZE - 8:
        scale = float(rng.uniform(0.5, 1.6))
        word = "".join(letters[int(k)] for k in rng.integers(0, len(letters), 6))
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(page, word, (8, y), font, scale, ink, int(rng.integers(1, 5)))
        y += int(18 + 14 * scale)
    image = page.astype(np.float32)
    if rng.random() < 0.6:
        left, top = int(rng.integers(10, 60)), int(rng.integers(40, 80))
        for k in range(5):
            bar = int(rng.integers(5, 36))
            base = (left + 10 * k, top + 36 - bar)
            cv2.rectangle(image, base, (base[0] + 7, top + 36), _tone(rng), -1)
    return image


def picture(rng: Rng) -> Floats:
    """Framed painting, print or poster."""
    image = (_shapes, _landscape, _poster, _shapes)[int(rng.integers(4))](rng)
    if rng.random() < 0.3:
        swirl = mix(colour(rng), colour(rng), 0.5 + 0.7 * np.sin(2 * noise(rng, 2.0)))
        image = mix(image, swirl, fill(np.ones(3, np.float32))[..., 0] * 0.6)
    image = np.ascontiguousarray(image, np.float32)
    if rng.random() < 0.5:
        image = frame(image, int(rng.integers(10, 22)), np.full(3, 240, np.float32))
    edge = wood_colour(rng) if rng.random() < 0.5 else colour(rng, (0.0, 0.5), (0.05, 0.95))
    return frame(image, int(rng.integers(3, 9)), edge)


def foliage(rng: Rng) -> Floats:
    """Leaves against the dark inside of a plant."""
    image = fill(colour(rng, (0.3, 0.7), (0.1, 0.3), (0.2, 0.42)))
    hue = rng.uniform(0.2, 0.38)
    long, wide = int(rng.integers(7, 18)), int(rng.integers(2, 7))
    for _ in range(120):
        tone = colour(rng, (0.3, 0.8), (0.25, 0.8), (hue - 0.05, hue + 0.05))
        centre = (int(rng.integers(SIZE)), int(rng.integers(SIZE)))
        angle = float(rng.uniform(0, 360))
        cv2.ellipse(image, centre, (long, wide), angle, 0, 360, tuple(map(float, tone)), -1)
    return image


def box(rng: Rng) -> Floats:
    """Cardboard or plastic crate with tape and label."""
    base = wood_colour(rng, (0.5, 0.8)) if rng.random() < 0.6 else colour(rng, (0.3, 0.8))
    image = modulate(fill(base), noise(rng, 1.5), 0.04)
    image[:, 58:70] = mix(base, np.full(3, 230, np.float32), np.full(1, 0.4, np.float32))[0]
    left, top = int(rng.integers(8, 70)), int(rng.integers(16, 80))
    cv2.rectangle(image, (left, top), (left + 44, top + 30), _tone(rng, (0.0, 0.5)), -1)
    for k in range(int(rng.integers(1, 5))):
        end = left + int(rng.integers(16, 40))
        cv2.line(image, (left + 4, top + 6 + 6 * k), (end, top + 6 + 6 * k), (30.0, 30.0, 30.0), 2)
    return frame(image, 3, base * np.float32(0.7))


def appliance(rng: Rng) -> Floats:
    """Oven, washer, fridge or server: a box with a porthole, panes and a control strip."""
    image = modulate(
        fill(colour(rng, (0.0, 0.15), (0.2, 0.95))), noise(rng, 0.6, along_y=0.05), 0.03
    )
    kind = int(rng.integers(4))
    if kind == 0:
        cv2.circle(image, (64, 74), int(rng.integers(28, 44)), (190.0, 190.0, 195.0), -1)
        cv2.circle(image, (64, 74), int(rng.integers(18, 26)), _tone(rng), -1)
    elif kind == 1:
        cv2.rectangle(image, (14, 40), (114, int(rng.integers(80, 112))), (25.0, 25.0, 30.0), -1)
        cv2.rectangle(image, (14, 30), (114, 35), (200.0, 200.0, 200.0), -1)
    elif kind == 2:
        split = int(rng.integers(35, 80))
        image[split : split + 3] *= 0.4
        cv2.rectangle(image, (14, split - 26), (19, split - 6), (120.0, 120.0, 120.0), -1)
        cv2.rectangle(image, (14, split + 10), (19, split + 36), (120.0, 120.0, 120.0), -1)
    else:
        for y in range(10, 120, int(rng.integers(8, 20))):
            cv2.rectangle(image, (10, y), (118, y + 4), _tone(rng), -1)
    for k in range(int(rng.integers(2, 7))):
        cv2.circle(image, (16 + 14 * k, 14), 4, _tone(rng), -1)
    return frame(image, 3, image[1, 1] * np.float32(0.6))


def screen(rng: Rng) -> Floats:
    """Television or monitor, off or showing windows."""
    image = fill(np.full(3, rng.uniform(8, 35), np.float32))
    if rng.random() < 0.6:
        image = _shapes(rng) if rng.random() < 0.5 else _poster(rng)
    else:
        image = mix(
            image, np.full(3, 90, np.float32), 0.8 - 3 * np.abs(X - Y - rng.uniform(-0.5, 0.5))
        )
    return frame(np.ascontiguousarray(image, np.float32), 5, np.full(3, 22, np.float32))


@cache
def _photo(name: str) -> Floats:
    data = resources.files("cbe_hil_sim").joinpath("photos", f"{name}.jpg").read_bytes()
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        raise WorldError(f"photo texture {name}.jpg is damaged; reinstall the package")
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB).astype(np.float32)


def photo(rng: Rng, columns: tuple[float, float]) -> Floats:
    """Recoloured crop of a packaged photo, from its `columns` (fractions of its width) only."""
    image = _photo(PHOTOS[int(rng.integers(len(PHOTOS)))])
    left, right = (round(c * image.shape[1]) for c in columns)
    side = int(rng.uniform(0.6, 1.0) * min(right - left, image.shape[0]))
    x = left + int(rng.integers(right - left - side + 1))
    y = int(rng.integers(image.shape[0] - side + 1))
    crop = cv2.resize(image[y : y + side, x : x + side], (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.5:
        crop = crop[:, ::-1]
    if rng.random() < 0.5:
        grey = crop.mean(axis=2) / 255.0
        crop = mix(colour(rng, (0.1, 0.7), (0.1, 0.5)), colour(rng, (0.0, 0.5), (0.7, 1.0)), grey)
    else:
        crop = crop * rng.uniform(0.7, 1.2, 3).astype(np.float32)
    return frame(np.ascontiguousarray(crop, np.float32), int(rng.integers(1, 8)), colour(rng))
