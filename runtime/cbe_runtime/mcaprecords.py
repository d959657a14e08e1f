"""The records of an MCAP file, refused where few bytes ask for much memory or time."""

from __future__ import annotations

import struct
import zlib
from io import SEEK_CUR, BytesIO
from typing import IO, TYPE_CHECKING

from mcap import stream_reader
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk

if TYPE_CHECKING:
    from collections.abc import Iterator

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 24 * 2**20
"""Also of a chunk unpacked: room for the largest raw image that is ever decoded, and a few more."""
MAX_EXPANSION = 1_000
"""Bytes unpacked for each of the file's, over the whole of it; a drive has a few."""
_HEAD = struct.Struct("<BQ")  # every record's: what it is and how many bytes follow

# A cut or forged record shows in any of these; each library raises its own.
DAMAGE = (
    McapError,
    struct.error,
    ValueError,
    EOFError,
    OverflowError,
    RuntimeError,
    stream_reader.zstandard.ZstdError,  # type: ignore[attr-defined]
)


class Damaged(Exception):
    """The stream ends or breaks before its end mark."""


def records(file: IO[bytes], size: int) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of schemas, channels and messages, chunks opened, up to the data's end.

    Raises:
        Damaged: the file of `size` bytes is none, or asks for more than it may.
        DAMAGE: it is cut short or forged.
    """
    if file.read(len(MAGIC)) != MAGIC:
        raise Damaged("it does not begin like one")
    allowed_bytes = MAX_RECORD_BYTES + MAX_EXPANSION * size
    while True:
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
            if length > size:
                raise Damaged(f"a record declares {length} bytes in a file of {size}")
            file.seek(length, SEEK_CUR)
            continue
        if length > MAX_RECORD_BYTES:
            raise Damaged(f"a record declares {length} bytes, more than {MAX_RECORD_BYTES}")
        content = file.read(length)
        if len(content) < length:
            raise Damaged(f"a record of {length} bytes ends after {len(content)}")
        if opcode != Opcode.CHUNK:
            yield opcode, memoryview(content)
            continue
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        allowed_bytes -= chunk.uncompressed_size
        if allowed_bytes < 0:
            raise Damaged("it unpacks to far more than a recording of its size holds")
        yield from _opened(chunk)


def _opened(chunk: Chunk) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of a chunk's records, its checksum having been checked."""
    data = _unpacked(chunk)
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise Damaged("a chunk's checksum does not match")
    view, at = memoryview(data), 0
    # Each record takes at least a few bits, however well a chunk compresses.
    for _ in range(len(chunk.data) + 1):
        if at == len(view):
            return
        opcode, length = _HEAD.unpack_from(view, at)
        at += _HEAD.size + length
        if at > len(view):
            raise Damaged(f"a record of {length} bytes goes beyond its chunk")
        yield opcode, view[at - length : at]
    raise Damaged(f"a chunk of {len(chunk.data)} bytes holds more records than bytes")


def _unpacked(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES:
        raise Damaged(f"a chunk declares {size} bytes, more than {MAX_RECORD_BYTES}")
    data = chunk.data
    if chunk.compression == "zstd":
        zstandard = stream_reader.zstandard  # type: ignore[attr-defined]
        # What the frame itself declares is what zstandard would reserve.
        if zstandard.frame_content_size(data) > size:
            raise Damaged("a chunk's frame declares more bytes than the chunk")
        data = zstandard.decompress(data, size)
    elif chunk.compression == "lz4" and (lz4 := getattr(stream_reader, "lz4", None)) is not None:
        data = lz4.LZ4FrameDecompressor().decompress(data, size + 1)
    elif chunk.compression:
        raise Damaged(f"its chunks are compressed by {chunk.compression[:32]!r}; use zstd")
    if len(data) != size:
        raise Damaged(f"a chunk of {size} bytes unpacks to {len(data)}")
    return data
