"""Small worlds made by hand."""

import numpy as np
import pytest

from cbe_hil_sim.world import Surfaces, World

CEILING_M = 2.5
SURFACES = 6


@pytest.fixture
def make_room():
    """Maker of walled rooms (rows x columns cells), bare or furnished."""

    def make(rows=60, columns=80, *, furnished=False):
        shape = (rows, columns)
        solid, bottom, top = (np.zeros(shape, np.float32) for _ in range(3))
        solid[:2] = solid[-2:] = solid[:, :2] = solid[:, -2:] = CEILING_M
        side, cap, span, floor, ceiling = (np.full(shape, n, np.uint16) for n in range(5))
        if furnished:
            solid[:35, 50:53] = CEILING_M  # a wall with a doorway beyond
            bottom[35:48, 50:53], top[35:48, 50:53] = 2.0, CEILING_M  # lintel
            solid[48:, 50:53] = CEILING_M
            solid[2:10, 20:30], side[2:10, 20:30] = 0.8, 5  # cupboard
            bottom[40:50, 12:26], top[40:50, 12:26] = 0.7, 0.75  # table top
            for row, column in ((40, 12), (40, 25), (49, 12), (49, 25)):
                solid[row, column] = 0.7
            solid[20, 2:50] = np.where(np.arange(48) < 20, 0.1, 0.0)  # below the scan
        rng = np.random.default_rng(0)
        # Blotches, as wide as a pixel or wider: what is compared is the mapping, not aliasing.
        coarse = rng.integers(40, 220, (SURFACES, 8, 8, 3)).astype(np.uint8)
        surfaces = Surfaces(
            np.arange(SURFACES, dtype=np.int32),
            rng.uniform(-1.0, 1.0, (SURFACES, 3)).astype(np.float32),
            rng.uniform(0.8, 1.6, (SURFACES, 2)).astype(np.float32),
            rng.uniform(0.6, 1.2, (SURFACES, 3)).astype(np.float32),
        )
        textures = coarse.repeat(16, axis=1).repeat(16, axis=2)
        return World(
            solid, bottom, top, side, cap, span, floor, ceiling, CEILING_M, surfaces, textures,
            origin_m=(-1.0, 0.5), name="room",
        )  # fmt: skip

    return make
