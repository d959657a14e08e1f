"""How alike two places look, from their attractors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cbe.signature import ATTRACTOR_SHAPE

if TYPE_CHECKING:
    from numpy.typing import NDArray

TURN_COLUMNS = 2
"""A turn of about 12 deg shifts an attractor by a column: up to this many are made up for."""
ALIKE = 0.30
"""Below this, two attractors are of one place.

Measured with two models on 68 views of 8 drives in validation worlds: of views within 0.3 m and
15 deg of one another 97 % and more are below it, of 2,080 pairs of other places (more than 2 m or
60 deg apart, or in another world) fewer than 0.5 %.
"""
NEARER = 0.004
"""By so much is a view less unlike another, a tick later, if the robot comes nearer to it."""


def unlikeness(
    attractor: NDArray[np.float32], others: NDArray[np.float32], turn_columns: int = TURN_COLUMNS
) -> NDArray[np.float32]:
    """RMS difference (...) of an attractor (400,) from `others` (..., 400), 0 to 1.

    The least over shifts by up to `turn_columns` columns; 0 holds small turns to be differences.
    """
    columns = ATTRACTOR_SHAPE[-1]
    one = attractor.reshape(ATTRACTOR_SHAPE)
    other = others.reshape(*others.shape[:-1], *ATTRACTOR_SHAPE)
    errors = []
    for shift in range(-turn_columns, turn_columns + 1):
        left, right = max(shift, 0), max(-shift, 0)
        seen = one[..., left : columns - right]
        difference = seen - other[..., right : columns - left]
        errors.append(np.square(difference).mean(axis=(-3, -2, -1)))
    least: NDArray[np.float32] = np.sqrt(np.min(errors, axis=0))
    return least


def visible(image: NDArray[np.uint8]) -> float:
    """Share (0 to 1) of a view (64, 64, 3) within the borders that a narrower camera leaves black.

    Borders are alike anywhere, so views of a narrower camera are less unlike on the whole.
    """
    rows, columns = np.nonzero(image.max(axis=-1))
    if not len(rows):
        return 0.0
    seen = (int(np.ptp(rows)) + 1) * (int(np.ptp(columns)) + 1)
    return seen / float(image[..., 0].size)
