"""The texture bank: about 330 painted and photographed textures per split, made on first use."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from cbe.errors import WorldError
from cbe_hil_sim import coverings, furnishings
from cbe_hil_sim.patterns import Painter

SPLITS = ("train", "validation", "test")

PAINTERS: dict[str, tuple[Painter, int]] = {
    "plaster": (coverings.plaster, 22),
    "wallpaper": (coverings.wallpaper, 24),
    "mural": (coverings.mural, 14),
    "brick": (coverings.brick, 6),
    "panelling": (coverings.panelling, 10),
    "tiled_wall": (coverings.tiled_wall, 8),
    "wood_floor": (coverings.wood_floor, 14),
    "parquet": (coverings.parquet, 5),
    "tile_floor": (coverings.tile_floor, 12),
    "checker": (coverings.checker, 5),
    "carpet": (coverings.carpet, 14),
    "marble": (coverings.marble, 9),
    "plain_ceiling": (coverings.plain_ceiling, 6),
    "panel_ceiling": (coverings.panel_ceiling, 8),
    "lamp": (coverings.lamp, 4),
    "rug": (coverings.rug, 14),
    "wood": (furnishings.wood, 14),
    "lacquer": (furnishings.lacquer, 12),
    "fabric": (furnishings.fabric, 18),
    "bedding": (furnishings.bedding, 6),
    "cabinet": (furnishings.cabinet, 18),
    "bookshelf": (furnishings.bookshelf, 12),
    "door": (furnishings.door, 8),
    "window": (furnishings.window, 16),
    "picture": (furnishings.picture, 32),
    "foliage": (furnishings.foliage, 6),
    "box": (furnishings.box, 6),
    "appliance": (furnishings.appliance, 8),
    "screen": (furnishings.screen, 4),
}
PHOTO_COUNT = 20
# Photos are few, so each split crops its own columns of them.
PHOTO_COLUMNS = {"train": (0.0, 0.6), "validation": (0.6, 0.8), "test": (0.8, 1.0)}


def _ranges() -> dict[str, range]:
    ranges, start = {}, 0
    for name, count in [(n, c) for n, (_, c) in PAINTERS.items()] + [("photo", PHOTO_COUNT)]:
        ranges[name] = range(start, start + count)
        start += count
    return ranges


FAMILIES: dict[str, range] = _ranges()
"""Indices into every split's bank by family."""


@cache
def bank(split: str) -> NDArray[np.uint8]:
    """Textures (N, 128, 128, 3) uint8 RGB of one split; the array is shared and read-only.

    Every split draws from the same painters with random numbers of its own.

    Raises:
        WorldError: unknown split.
    """
    if split not in SPLITS:
        raise WorldError(f"unknown split {split!r}; expected one of {', '.join(SPLITS)}")
    key = SPLITS.index(split)
    images = []
    for family, (painter, count) in enumerate(PAINTERS.values()):
        images += [painter(np.random.default_rng([key, family, k])) for k in range(count)]
    for k in range(PHOTO_COUNT):
        rng = np.random.default_rng([key, len(PAINTERS), k])
        images.append(furnishings.photo(rng, PHOTO_COLUMNS[split]))
    stacked = np.clip(np.rint(np.stack(images)), 0.0, 255.0).astype(np.uint8)
    stacked.setflags(write=False)
    return stacked
