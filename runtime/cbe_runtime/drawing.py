"""Routes as pictures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import RouteError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

WIDTH, HEIGHT = 1200, 900  # px, at most
MARGIN = 70
TOP, BOTTOM = 90, 60  # for text
LABELS = 40  # joints that get a number: more would hide the path
GRID_LINES = 12
WHITE, BLACK, GREY, FAINT = (255, 255, 255), (30, 30, 30), (110, 110, 110), (228, 228, 228)
FIRST, LAST = np.array([190.0, 110.0, 20.0]), np.array([40.0, 60.0, 215.0])  # BGR
START = (70, 150, 40)


class Canvas:
    """A picture (h, w, 3) uint8 BGR of a plane in m, x to the right and y up."""

    def __init__(self, low_m: NDArray[np.float64], high_m: NDArray[np.float64]) -> None:
        """Show at least the rectangle from `low_m` (2,) to `high_m` (2,)."""
        extent = np.maximum(high_m - low_m, 1.0)
        room = np.array([WIDTH - 2 * MARGIN, HEIGHT - TOP - BOTTOM - 2 * MARGIN])
        self.px_per_m = float((room / extent).min())
        # A straight drive is still given a picture that its text fits on.
        self._width = WIDTH
        self._height = max(round(extent[1] * self.px_per_m), 160) + TOP + BOTTOM + 2 * MARGIN
        self._centre_m = 0.5 * (low_m + high_m)
        self.pixels: NDArray[np.uint8] = np.full((self._height, self._width, 3), 255, np.uint8)

    def at(self, points_m: NDArray[np.float64]) -> NDArray[np.int32]:
        """Pixels (N, 2) of points (N, 2)."""
        offset = (points_m - self._centre_m) * self.px_per_m * np.array([1.0, -1.0])
        middle = np.array([0.5 * self._width, TOP + 0.5 * (self._height - TOP - BOTTOM)])
        pixels: NDArray[np.int32] = np.rint(middle + offset).astype(np.int32)
        return pixels

    def line(
        self, points_m: NDArray[np.float64], colour: Sequence[float], thickness: int = 1
    ) -> None:
        """A line through points (N, 2)."""
        import cv2

        cv2.polylines(self.pixels, [self.at(points_m)], False, colour, thickness, cv2.LINE_AA)

    def dot(self, point_m: NDArray[np.float64], colour: Sequence[float], radius: int) -> None:
        """A disc with a white rim at a point (2,)."""
        import cv2

        x, y = self.at(point_m[None])[0].tolist()
        cv2.circle(self.pixels, (x, y), radius + 2, WHITE, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(self.pixels, (x, y), radius, colour, cv2.FILLED, cv2.LINE_AA)

    def arrow(
        self, start_m: NDArray[np.float64], end_m: NDArray[np.float64], colour: Sequence[float]
    ) -> None:
        """An arrow from a point (2,) to another."""
        import cv2

        tail, tip = self.at(np.stack([start_m, end_m])).tolist()
        cv2.arrowedLine(self.pixels, tail, tip, colour, 3, cv2.LINE_AA, tipLength=0.4)

    def text(
        self, words: str, x: int, y: int, colour: Sequence[float] = BLACK, size: float = 0.5
    ) -> None:
        """Words from pixel (x, y) on; a negative y counts from below. ASCII only."""
        import cv2

        at = (x, y if y >= 0 else self._height + y)
        plain = words.encode("ascii", "replace").decode()
        for line_colour, thickness in ((WHITE, 4), (colour, 1)):
            cv2.putText(
                self.pixels, plain, at, cv2.FONT_HERSHEY_SIMPLEX, size, line_colour, thickness,
                cv2.LINE_AA,
            )  # fmt: skip

    def grid(self) -> float:
        """Faint lines at a round spacing, which is returned in m."""
        span_m = max(self._width, self._height) / self.px_per_m
        spacing = _round_up(span_m / GRID_LINES)
        corner = np.array([0.5 * self._width, 0.5 * self._height]) / self.px_per_m
        low, high = self._centre_m - 2.0 * corner, self._centre_m + 2.0 * corner
        for axis in (0, 1):
            for step in range(math.floor(low[axis] / spacing), math.ceil(high[axis] / spacing) + 1):
                ends = np.stack([low, high])
                ends[:, axis] = step * spacing
                self.line(ends, FAINT)
        return spacing


def draw(paths: Sequence[NDArray[np.float64]], title: str) -> NDArray[np.uint8]:
    """A picture (h, w, 3) uint8 BGR of a route's paths (N, 2) in m, one a segment.

    Setting out to the right; colours run from blue to red, joints are numbered dots.
    """
    everything = np.concatenate(paths)
    canvas = Canvas(everything.min(axis=0), everything.max(axis=0))
    spacing = canvas.grid()
    last = len(paths) - 1
    for index, path in enumerate(paths):
        share = index / max(last, 1)
        colour = ((1.0 - share) * FIRST + share * LAST).tolist()
        canvas.line(path, colour, 4)
    every = math.ceil(len(paths) / LABELS)
    for index, path in enumerate(paths[1:], start=1):
        if index % every == 0:
            canvas.dot(path[0], BLACK, 5)
            x, y = canvas.at(path[:1])[0].tolist()
            canvas.text(str(index), x + 9, y - 9)
    canvas.dot(paths[0][0], START, 9)
    _arrow_head(canvas, paths[-1])
    length_m = sum(float(np.hypot(*np.diff(path, axis=0).T).sum()) for path in paths)
    canvas.text(title, 24, 36, size=0.75)
    canvas.text(
        f"{length_m:.1f} m in {len(paths)} segments; green: start, arrow: end, dots: joints",
        24, 66, GREY,
    )  # fmt: skip
    canvas.text(
        f"dead-reckoned from the embeddings, so errors add up; a square is {spacing:g} m",
        24, -24, GREY,
    )  # fmt: skip
    return canvas.pixels


def write_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write a picture (h, w, 3) uint8 BGR as a PNG file.

    Raises:
        RouteError: the file cannot be written.
    """
    import cv2

    _, data = cv2.imencode(".png", pixels)
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise RouteError(
            f"cannot write {path}: {error.strerror}; free space or choose another folder"
        ) from error


def _arrow_head(canvas: Canvas, path: NDArray[np.float64]) -> None:
    """Where a path (N, 2) ends and which way it then looks."""
    ahead = path[-1] - path[-2]
    unit = ahead / max(float(np.hypot(*ahead)), 1e-9)
    canvas.arrow(path[-1], path[-1] + unit * 34.0 / canvas.px_per_m, tuple(LAST.tolist()))


def _round_up(length: float) -> float:
    """The next of 1, 2 and 5 times a power of ten, at least 0.1."""
    power = 10.0 ** math.floor(math.log10(max(length, 0.1)))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= length)
