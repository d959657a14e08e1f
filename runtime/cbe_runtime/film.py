"""Pictures of a drive as a film, or as one sheet of its most telling moments."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import RecordingError
from cbe.robot import STEP_S
from cbe_runtime.panel import HEIGHT, WIDTH

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray

    from cbe_runtime.panel import Panel, Scene

COLUMNS, ROWS = 3, 4
GAP = 6
CODECS = {".mp4": ("avc1", "mp4v"), ".webm": ("VP90", "VP80"), ".avi": ("MJPG",)}
"""The best that this OpenCV can write is taken."""


class Film:
    """A film of pictures at 10 Hz; `with` finishes it."""

    def __init__(self, path: Path) -> None:
        """Begin.

        Raises:
            RecordingError: this OpenCV cannot write such a file there.
        """
        import cv2

        if path.suffix not in CODECS:
            raise RecordingError(f"{path} should end in one of {', '.join(CODECS)}")
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            for codec in CODECS[path.suffix]:
                code = cv2.VideoWriter.fourcc(*codec)
                self._writer = cv2.VideoWriter(str(path), code, 1.0 / STEP_S, (WIDTH, HEIGHT))
                if self._writer.isOpened():
                    return
        finally:
            cv2.utils.logging.setLogLevel(level)
        raise RecordingError(
            f"cannot write {path}: the folder is not writable, or this OpenCV has no encoder for "
            "it; try another ending (.avi), or --sheet out.png"
        )

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Append a picture (HEIGHT, WIDTH, 3) uint8 BGR."""
        self._writer.write(pixels)

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.release()


def sheet(scenes: Sequence[Scene], panel: Panel) -> NDArray[np.uint8]:
    """A picture of up to twelve scenes in rows, from left to right (h, w, 3) uint8 BGR."""
    import cv2

    small = (WIDTH * 2 // 3, HEIGHT * 2 // 3)
    columns = min(COLUMNS, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    height, width = rows * (small[1] + GAP) + GAP, columns * (small[0] + GAP) + GAP
    pixels: NDArray[np.uint8] = np.full((height, width, 3), 255, np.uint8)
    for index, scene in enumerate(scenes):
        y = GAP + index // columns * (small[1] + GAP)
        x = GAP + index % columns * (small[0] + GAP)
        shown = cv2.resize(panel.draw(scene), small, interpolation=cv2.INTER_AREA)
        pixels[y : y + small[1], x : x + small[0]] = shown
    return pixels


class Album:
    """Keeps the scenes of a sheet while a drive goes by whose length is not known.

    What is marked stays as long as there is room; between, scenes are spread over the drive.
    """

    def __init__(self, room: int = COLUMNS * ROWS) -> None:
        self._room = room
        self._marked: list[tuple[int, Scene]] = []
        self._spread: list[tuple[int, Scene]] = []
        self._every = 1
        self._count = 0
        self._last: tuple[int, Scene] | None = None

    def add(self, scene: Scene, *, marked: bool = False) -> None:
        """Take the next scene in."""
        entry = (self._count, scene)
        if marked and len(self._marked) < self._room // 2:
            self._marked.append(entry)
        elif self._count % self._every == 0:
            self._spread.append(entry)
            if len(self._spread) > 4 * self._room:
                self._every *= 2
                self._spread = [each for each in self._spread if each[0] % self._every == 0]
        self._last = entry
        self._count += 1

    def scenes(self) -> list[Scene]:
        """The chosen ones, in order; the last is among them."""
        if self._last is None:
            return []
        kept = dict([*self._marked, self._last])
        between = [each for each in self._spread if each[0] not in kept]
        room = min(self._room - len(kept), len(between))
        if room > 0:
            places = np.linspace(0, len(between) - 1, room).round().astype(int).tolist()
            kept |= dict(between[place] for place in places)
        return [kept[count] for count in sorted(kept)]


def draw_all(film: Film | None, album: Album | None, panel: Panel) -> Callable[[Scene, bool], None]:
    """What takes each scene of a drive, marked or not."""

    def take(scene: Scene, marked: bool) -> None:
        if film is not None:
            film.add(panel.draw(scene))
        if album is not None:
            album.add(scene, marked=marked)

    return take
