"""Randomised image formation: exposure, gamma, tint, noise, blur and black borders."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Appearance:
    """How B cameras turn light into pixels."""

    tone: NDArray[np.uint8]  # (B, 3, 256) lookup of each channel
    noise: NDArray[np.float32]  # (B,) standard deviation in grey levels
    blur: NDArray[np.float32]  # (B,) weight of the four neighbours, 0 to 0.2
    border: NDArray[np.int64]  # (B, 2) black columns and rows on each side
    pitch_px: NDArray[np.float32]  # (B,)
    height_m: NDArray[np.float32]  # (B,)

    def take(self, index: NDArray[np.intp]) -> "Appearance":
        """Rows `index` of every field."""
        return Appearance(
            self.tone[index],
            self.noise[index],
            self.blur[index],
            self.border[index],
            self.pitch_px[index],
            self.height_m[index],
        )


def sample(rng: np.random.Generator, count: int, height_m: float) -> Appearance:
    """Draw `count` cameras; `height_m` is the mast's nominal height."""
    gain = np.exp(rng.normal(0.0, 0.2, (count, 1, 1)))
    tint = np.exp(rng.normal(0.0, 0.05, (count, 3, 1)))
    gamma = np.exp(rng.normal(0.0, 0.2, (count, 1, 1)))
    offset = rng.normal(0.0, 0.02, (count, 1, 1))
    level = np.arange(256)[None, None, :] / 255.0
    tone = np.clip(gain * tint * level**gamma + offset, 0.0, 1.0) * 255.0
    narrow = rng.random(count) < 0.2  # narrower cameras leave black borders
    border = np.stack([rng.integers(1, 21, count), rng.integers(0, 21, count)], axis=1)
    border = np.where(rng.random((count, 1)) < 0.5, rng.integers(15, 21, (count, 2)), border)
    return Appearance(
        tone=np.round(tone).astype(np.uint8),
        noise=(rng.random(count) ** 2 * 8.0).astype(np.float32),
        blur=(np.maximum(rng.uniform(-0.15, 0.15, count), 0.0)).astype(np.float32),
        border=np.where(narrow[:, None], border, 0).astype(np.int64),
        pitch_px=rng.normal(0.0, 0.5, count).astype(np.float32),
        height_m=rng.normal(height_m, 0.02, count).astype(np.float32),
    )


def vary(rng: np.random.Generator, shown: Appearance) -> Appearance:
    """The same cameras on another day: a slightly different exposure and tint."""
    count = len(shown.noise)
    gain = np.exp(rng.normal(0.0, 0.08, (count, 1, 1)) + rng.normal(0.0, 0.02, (count, 3, 1)))
    tone = np.clip(np.round(shown.tone * gain), 0, 255).astype(np.uint8)
    pitch = shown.pitch_px + rng.normal(0.0, 0.2, count).astype(np.float32)
    return Appearance(tone, shown.noise, shown.blur, shown.border, pitch, shown.height_m)


def apply(
    appearance: Appearance, images: NDArray[np.uint8], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Pass rendered images (B, H, W, 3) through their cameras."""
    return _apply(
        images,
        appearance.tone,
        appearance.noise,
        appearance.blur,
        appearance.border,
        rng.standard_normal(1 << 16, dtype=np.float32),
        rng.integers(0, 1 << 16, len(images)),
    )


@numba.njit(cache=True, parallel=True, nogil=True)
def _apply(images, tone, noise, blur, border, normals, start):  # type: ignore[no-untyped-def]
    count, height, width, _ = images.shape
    out = np.zeros_like(images)
    mask = len(normals) - 1
    for b in numba.prange(count):
        columns, rows = border[b, 0], border[b, 1]
        k = start[b]
        side = blur[b]
        for y in range(rows, height - rows):
            up, down = max(y - 1, 0), min(y + 1, height - 1)
            for x in range(columns, width - columns):
                left, right = max(x - 1, 0), min(x + 1, width - 1)
                for c in range(3):
                    value = np.float32(images[b, y, x, c])
                    if side > 0.0:
                        around = np.float32(images[b, up, x, c]) + np.float32(images[b, down, x, c])
                        around += np.float32(images[b, y, left, c])
                        around += np.float32(images[b, y, right, c])
                        value = (1.0 - 4.0 * side) * value + side * around
                    value = tone[b, c, int(value)] + noise[b] * normals[k & mask]
                    k += 1
                    out[b, y, x, c] = np.uint8(min(max(value, 0.0), 255.0))
    return out
