"""Feeds inputs to a reader and holds it to its promise: a value or a CbeError, soon and small."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from io import FileIO
from itertools import chain, islice
from pathlib import Path

from cbe.errors import CbeError

SEEDS = Path(__file__).parent / "seeds"
"""By kind of input: what once escaped."""

INPUTS = int(os.environ.get("CBE_FUZZ_INPUTS", "1000"))
SEED = int(os.environ.get("CBE_FUZZ_SEED", "0"))

MAX_INPUT_S = 1.0
"""Of processor time, so that a busy machine does not look like a hang."""
MAX_GROWTH_BYTES = 64 * 2**20
MAX_REASON = 2_000
"""Characters of a refusal: one that quotes all it was given is no explanation."""
MAX_ESCAPES = 20


@dataclass(frozen=True)
class Report:
    """What came of one kind of input."""

    kind: str
    inputs: int
    accepted: int
    slowest_s: float
    growth_bytes: int

    def __str__(self) -> str:
        return (
            f"{self.kind}: {self.inputs} inputs, {self.accepted} accepted, slowest "
            f"{1000 * self.slowest_s:.0f} ms, growth {self.growth_bytes / 2**20:.1f} MiB"
        )


class Escapes(AssertionError):
    """Inputs that were neither read nor refused as they must be."""


def kept(kind: str) -> list[bytes]:
    """The seeds of inputs that once escaped."""
    return [path.read_bytes() for path in sorted((SEEDS / kind).glob("*"))]


def fuzz(
    kind: str,
    read: Callable[[bytes], object],
    valid: Iterable[bytes],
    hostile: Iterator[bytes],
    folder: Path,
    attacks: Iterable[bytes] = (),
    share: float = 1.0,
) -> Report:
    """Read what is valid, what once escaped, the hand-made attacks and so many hostile inputs.

    Raises:
        Escapes: any other exception than a CbeError, a hang or growth; each input that did it is
            left in `folder`.
    """
    for data in valid:
        read(data)
    count = max(int(INPUTS * share), 1)
    with (folder / "last-input").open("wb", buffering=0) as last:
        judge = _Judge(read, last)
        for data in chain(kept(kind), attacks):
            judge.take_alone(data)
        judge.take_all(islice(hostile, count))
    if judge.escapes:
        raise Escapes(f"{kind}: " + "\n".join(judge.escapes.values()))
    return Report(kind, judge.inputs, judge.accepted, judge.slowest_s, judge.growth_bytes)


class _Judge:
    """Reads one input after another; `last` holds what a crash of the process leaves behind."""

    def __init__(self, read: Callable[[bytes], object], last: FileIO) -> None:
        self._read = read
        self._last = last
        self.inputs = self.accepted = self.growth_bytes = 0
        self.slowest_s = 0.0
        self.escapes: dict[str, str] = {}

    def take_alone(self, data: bytes) -> None:
        """Read an input that may be large itself, which does not count as growth."""
        memory = _Memory()
        self._take(data)
        self._judge_growth(data, memory)

    def take_all(self, inputs: Iterable[bytes]) -> None:
        """Read inputs; growth is that of all together, so that a leak shows."""
        memory = _Memory()
        for data in inputs:
            self._take(data)
        self._judge_growth(b"", memory)

    def _judge_growth(self, data: bytes, memory: _Memory) -> None:
        growth = memory.growth_bytes()
        self.growth_bytes = max(self.growth_bytes, growth)
        if growth > MAX_GROWTH_BYTES:
            what = f"memory{self.inputs}"
            self._escaped(data, what, f"memory grew by {growth / 2**20:.0f} MiB", None)

    def _take(self, data: bytes) -> None:
        self._last.seek(0)
        self._last.write(data)
        self._last.truncate()
        self.inputs += 1
        began_s = time.process_time()
        try:
            self._read(data)
            self.accepted += 1
        except CbeError as refusal:
            reason = str(refusal)
            if not 10 <= len(reason) <= MAX_REASON:
                self._escaped(data, "reason", f"a refusal of {len(reason)} characters", refusal)
        except Exception as escape:  # noqa: BLE001
            self._escaped(data, "", repr(escape)[:300], escape)
        took_s = time.process_time() - began_s
        self.slowest_s = max(self.slowest_s, took_s)
        if took_s > MAX_INPUT_S:
            self._escaped(data, f"slow{self.inputs}", f"{took_s:.1f} s for one input", None)

    def _escaped(self, data: bytes, what: str, shown: str, error: Exception | None) -> None:
        """Keep the first input of every place in the code that lets one out."""
        frames = traceback.extract_tb(error.__traceback__) if error else []
        place = " < ".join(f"{Path(each.filename).name}:{each.lineno}" for each in frames[:-5:-1])
        if f"{what}{place}" in self.escapes:
            return
        path = Path(self._last.name).parent / f"escape-{len(self.escapes)}"
        path.write_bytes(data)
        self.escapes[f"{what}{place}"] = f"{shown} at {place}: {len(data)} bytes in {path}"
        if len(self.escapes) >= MAX_ESCAPES:
            raise Escapes("\n".join(self.escapes.values()))


class _Memory:
    """The highest resident memory since it was made, above what was in use then."""

    def __init__(self) -> None:
        # Makes VmHWM start again from the present (proc(5)).
        Path("/proc/self/clear_refs").write_text("5")
        self._before = _status_bytes("VmRSS")

    def growth_bytes(self) -> int:
        return max(_status_bytes("VmHWM") - self._before, 0)


def _status_bytes(key: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return 1024 * int(line.split()[1])
    raise KeyError(key)
