"""Building blocks of the painted textures: periodic noise, palettes, courses of bricks and tiles.

Images are (SIZE, SIZE, 3) float32, 0 to 255, row 0 at the top; fields are (SIZE, SIZE) float32.
"""

import colorsys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

SIZE = 128

Floats = NDArray[np.float32]
Rng = np.random.Generator
Painter = Callable[[Rng], Floats]

_Y, _X = (grid.astype(np.float32) for grid in np.mgrid[0:SIZE, 0:SIZE])
X: Floats = (_X + np.float32(0.5)) / np.float32(SIZE)
Y: Floats = (_Y + np.float32(0.5)) / np.float32(SIZE)
_FREQUENCY_Y = np.fft.fftfreq(SIZE, 1.0 / SIZE)[:, None]
_FREQUENCY_X = np.fft.rfftfreq(SIZE, 1.0 / SIZE)[None, :]


def noise(rng: Rng, slope: float = 1.5, along_x: float = 1.0, along_y: float = 1.0) -> Floats:
    """Periodic noise of zero mean and unit deviation whose amplitude falls as frequency^-slope.

    `along_x`, `along_y` above 1 stretch it into streaks along that axis.
    """
    frequency = np.hypot(_FREQUENCY_X * along_x, _FREQUENCY_Y * along_y)
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * frequency**-slope
    field = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    scaled: Floats = (field / field.std()).astype(np.float32)
    return scaled


def colour(
    rng: Rng,
    saturation: tuple[float, float] = (0.1, 0.5),
    value: tuple[float, float] = (0.4, 0.9),
    hue: tuple[float, float] = (0.0, 1.0),
) -> Floats:
    """Return a random RGB colour (3,), 0 to 255, within HSV ranges."""
    hsv = (rng.uniform(*hue) % 1.0, rng.uniform(*saturation), rng.uniform(*value))
    return np.asarray(colorsys.hsv_to_rgb(*hsv), np.float32) * 255.0


def wood_colour(rng: Rng, value: tuple[float, float] = (0.3, 0.8)) -> Floats:
    """Return a brown between walnut and beech, (3,)."""
    return colour(rng, (0.3, 0.65), value, (0.04, 0.11))


def fill(base: Floats) -> Floats:
    """Return an image of one colour."""
    return np.full((SIZE, SIZE, 3), base, np.float32)


def mix(low: Floats, high: Floats, weight: NDArray[np.floating]) -> Floats:
    """Blend two colours or images by a field in [0, 1] (clipped)."""
    w = np.clip(weight, 0.0, 1.0)[..., None]
    return np.ascontiguousarray(low * (1.0 - w) + high * w, np.float32)


def modulate(image: Floats, field: NDArray[np.floating], strength: float) -> Floats:
    """Brighten and darken an image by a field of about unit deviation."""
    out = image * (1.0 + np.float32(strength) * field[..., None])
    return np.ascontiguousarray(out, np.float32)


def grain(rng: Rng, base: Floats, strength: float = 0.14) -> Floats:
    """Wood: streaks along x with slow colour drift."""
    streaks = noise(rng, 0.9, along_x=0.06, along_y=1.0)
    rings = np.sin(noise(rng, 1.6, along_x=0.1, along_y=0.5) * rng.uniform(2.0, 6.0))
    return modulate(fill(base), 0.6 * streaks + 0.5 * rings, strength)


def courses(
    columns: int, rows: int, shift: float = 0.0, joint: float = 0.06
) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Lay `rows` courses of `columns` units each, every second one shifted by `shift` units.

    Returns the joints' mask and each pixel's unit index; `joint` is a fraction of a course height.
    """
    row = np.floor(Y * rows)
    across = (X * columns + shift * (row % 2)) % columns
    column = np.floor(across)
    down = Y * rows - row
    width = joint * columns / rows
    joints = (down < joint) | ((across - column) < width)
    return joints, (row * columns + column).astype(np.intp)


def per_unit(rng: Rng, unit: NDArray[np.intp], spread: float) -> Floats:
    """Return a field that is constant on each unit, of deviation `spread`."""
    values = rng.standard_normal(int(unit.max()) + 1).astype(np.float32)
    field: Floats = values[unit] * np.float32(spread)
    return field


def frame(image: Floats, width: int, border: Floats) -> Floats:
    """Paint a border of `width` pixels with a darker inner edge."""
    out = image.copy()
    inner = slice(width, SIZE - width)
    kept = out[inner, inner].copy()
    out[:] = border * 0.6
    outer = slice(max(width - 2, 1), SIZE - max(width - 2, 1))
    edge = out[outer, outer].copy()
    out[:] = border
    out[outer, outer] = edge
    out[inner, inner] = kept
    return out
