"""Hostile bytes from valid examples: the same seed gives the same inputs everywhere."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator, Sequence

MAX_BYTES = 64 * 1024
"""A mutant grows no longer: size itself is attacked by hand-made inputs."""

_SIZES = {"B": 1, "H": 2, "I": 4, "Q": 8}
_LENGTHS = [0, 1, 2, 3, 7, 8, 9, 255, 256, 2**15, 2**16 - 1, 2**20, 2**24, 2**28]
_LENGTHS += [2**bits + more for bits in (31, 32, 62, 63, 64) for more in (-2, -1, 0, 1)]
_NUMBERS = [0.0, -0.0, 1.0, -1.0, 1e-45, 1e-310, 3.4e38, -3.4e38, 1e300, -1e300]
_NUMBERS += [float("nan"), float("inf"), float("-inf")]

Mutation = Callable[[random.Random, bytearray, Sequence[bytes]], None]


def mutants(seeds: Sequence[bytes], seed: int = 0, tokens: Sequence[bytes] = ()) -> Iterator[bytes]:
    """Endless variations of the seeds; `tokens` are pieces that mean something to the reader."""
    rng = random.Random(seed)
    pieces = [*tokens, *seeds] if tokens else list(seeds)
    while True:
        data = bytearray(rng.choice(seeds))
        for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
            rng.choice(_MUTATIONS)(rng, data, pieces)
        yield bytes(data[:MAX_BYTES])


def _place(rng: random.Random, data: bytearray, size: int = 1) -> int:
    """Where to strike: headers as often as everything behind them."""
    last = max(len(data) - size, 0)
    return rng.randint(0, min(last, 64) if rng.random() < 0.5 else last)


def _flip(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    for _ in range(rng.choice((1, 1, 2, 8))):
        if data:
            data[_place(rng, data)] ^= 1 << rng.randint(0, 7)


def _overwrite(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    if data:
        data[_place(rng, data)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randint(0, 255)))


def _truncate(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    del data[rng.randint(0, len(data)) :]


def _delete(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    start = _place(rng, data)
    del data[start : start + rng.choice((1, 2, 4, 8, rng.randint(1, 64)))]


def _repeat(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    start = _place(rng, data)
    part = data[start : start + rng.choice((1, 4, 16, 64, 1024))]
    data[start:start] = part * rng.choice((1, 1, 2, 10, 100))
    del data[MAX_BYTES:]


def _insert(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    start = _place(rng, data)
    data[start:start] = rng.randbytes(rng.choice((1, 2, 4, 8, 32)))


def _splice(rng: random.Random, data: bytearray, pieces: Sequence[bytes]) -> None:
    piece = rng.choice(pieces)
    start = rng.randint(0, len(piece))
    part = piece[start : start + rng.choice((1, 4, 16, 64, 256, len(piece)))]
    at = _place(rng, data)
    data[at : at + rng.choice((0, len(part)))] = part


def _token(rng: random.Random, data: bytearray, pieces: Sequence[bytes]) -> None:
    piece = rng.choice(pieces)[:1024]
    at = _place(rng, data)
    data[at : at + rng.choice((0, 1, len(piece)))] = piece


def _length(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    """A field of any width that says how much follows, or how many."""
    kind = rng.choice("BHIQ")
    value = rng.choice(_LENGTHS) % 256 ** _SIZES[kind]
    at = _place(rng, data, _SIZES[kind])
    data[at : at + _SIZES[kind]] = struct.pack(rng.choice("<>") + kind, value)


def _number(rng: random.Random, data: bytearray, _pieces: Sequence[bytes]) -> None:
    kind, size = rng.choice((("f", 4), ("d", 8)))
    value = rng.choice(_NUMBERS)
    if kind == "f" and abs(value) > 3.5e38:
        value = float("inf")
    at = _place(rng, data, size) // 4 * 4
    data[at : at + size] = struct.pack(rng.choice("<>") + kind, value)


_MUTATIONS: tuple[Mutation, ...] = (
    _flip,
    _flip,
    _overwrite,
    _truncate,
    _delete,
    _repeat,
    _insert,
    _splice,
    _token,
    _length,
    _length,
    _number,
    _number,
)
