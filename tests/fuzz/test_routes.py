"""Route files."""

import hashlib
from pathlib import Path

import msgpack

from cbe_runtime import routefile

from .harness import SEED
from .mutate import mutants

GOLDEN = (Path(__file__).parents[1] / "golden/route_v1.msgpack").read_bytes()
BODY = msgpack.unpackb(GOLDEN)["body"]
KEYS = [msgpack.packb(each) for each in (*"mcpqastu", "magic", "version", "sha256", "body", None)]
VALUES = [
    msgpack.packb(each)
    for each in (
        *(0, -1, 1, 2, 2**63, -(2**63), 2**64 - 1, 1e308, float("nan"), float("inf")),
        *("u4", "u8", "f32", "f16", "i8", "pinhole", "fisheye", "", "x" * 300, b"", bytes(36)),
        *([], {}, [[]], [bytes(64), 1], [0] * 8, {"a": "b"}, True, msgpack.Timestamp(0)),
    )
]
# Headers that declare far more than follows: arrays, maps, strings, bytes, extensions.
HEADS = [bytes([head]) + b"\xff" * 4 for head in b"\xdd\xdf\xdb\xc6\xc9\xdc\xde\xc7\xd4\xc1"]


def sealed(body: bytes) -> bytes:
    """A whole file around any body: what only the reader of the body can refuse."""
    digest = hashlib.sha256(body).digest()
    envelope = {"magic": "cbe-route", "version": 1, "sha256": digest, "body": body}
    return msgpack.packb(envelope)


def hostile():
    files = mutants([GOLDEN], SEED, [*KEYS, *VALUES, *HEADS])
    bodies = mutants([BODY], SEED + 1, [*KEYS, *VALUES, *HEADS])
    while True:
        yield next(files)
        for _ in range(3):
            yield sealed(next(bodies))


def attacks():
    deep = b"\x91" * 1_000_000
    many = b"\xdc\xff\xff" + b"\x90" * 65_535  # 65535 empty lists in 64 KB
    nested = b"\xdd\0\0\0\x70" + many * 112
    tags = b"".join(msgpack.packb(f"{n:x}") + b"\xa0" for n in range(900_000))
    whole = msgpack.unpackb(BODY)
    for bomb in (deep, many, nested, b"\xdf\0\x0d\xbb\xa0" + tags, b"\xc6\xff\xff\xff\xff"):
        yield bomb
        yield sealed(bomb)
        for key in "mcpqast":
            packed = msgpack.packb({name: whole[name] for name in whole if name != key})
            yield sealed(bytes([packed[0] + 1]) + packed[1:] + msgpack.packb(key) + bomb)
    yield b"\0" * (routefile.MAX_FILE_BYTES + 1)


def test_hostile_route_is_refused_soon_and_small(fuzzed, tmp_path):
    path = tmp_path / "route.msgpack"

    def read(data):
        path.write_bytes(data)
        route = routefile.load(path)
        for joint in range(len(route.attractors)):
            route.attractor(joint)
        routefile.dump(route)

    report = fuzzed("routes", read, [GOLDEN, sealed(BODY)], hostile(), attacks=attacks())
    assert 0 < report.accepted < report.inputs / 2, "some change only what may be anything"
