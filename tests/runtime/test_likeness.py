import numpy as np
import pytest

from cbe_runtime.likeness import visible


@pytest.mark.parametrize(
    ("rows", "columns", "share"),
    [((0, 64), (0, 64), 1.0), ((16, 48), (0, 64), 0.5), ((19, 45), (18, 46), 26 * 28 / 4096)],
)
def test_visible_is_what_lies_within_the_black_borders(rows, columns, share):
    image = np.zeros((64, 64, 3), np.uint8)
    image[slice(*rows), slice(*columns), 1] = 7
    image[30:34, 30:34] = 0  # something black is no border
    assert visible(image) == pytest.approx(share)


def test_nothing_is_visible_in_the_dark():
    assert visible(np.zeros((64, 64, 3), np.uint8)) == 0.0
