"""A progress bar on the terminal for work that takes longer than two seconds."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")

PATIENCE_S = 2.0
REFRESH_S = 0.2
WIDTH = 30


def track(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Pass items on while drawing to stderr; without `total` it counts."""
    begun = drawn = time.monotonic()
    count = 0
    shown = False
    for count, item in enumerate(items, start=1):
        yield item
        now = time.monotonic()
        if now - begun > PATIENCE_S and now - drawn > REFRESH_S:
            _draw(label, count, total)
            drawn, shown = now, True
    if shown:
        _draw(label, count, total)
        sys.stderr.write("\n")


def _draw(label: str, count: int, total: int | None) -> None:
    if total:
        filled = min(WIDTH * count // total, WIDTH)
        bar = f"[{'#' * filled}{'.' * (WIDTH - filled)}] {count}/{total}"
    else:
        bar = str(count)
    sys.stderr.write(f"\r{label} {bar}")
    sys.stderr.flush()
