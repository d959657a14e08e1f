"""What a JPEG or PNG file declares, checked before a decoder trusts it with memory and time."""

import struct
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cbe.errors import MessageError

JPEG, JPEG_END, JPEG_SCAN = b"\xff\xd8\xff", b"\xff\xd9", b"\xff\xda"
PNG = b"\x89PNG\r\n\x1a\n"
PNG_HEADER, PNG_DATA, PNG_END, PNG_ANIMATED = b"IHDR", b"IDAT", b"IEND", b"acTL"
MAX_PIXELS = 2**22
"""A board cannot decode more at 10 Hz, and few bytes can declare any number."""
MAX_FILE_BYTES = 4 * MAX_PIXELS
END_SEARCH = 64  # some encoders pad the file
MAX_SCANS = 32  # encoders write about ten; each may cost a pass over all pixels
MAX_PARTS = 10_000  # segments or chunks; encoders write a few, or one for some KB of pixels
HARMLESS_BYTES = 2**16  # what deflate makes of them, a thousandfold, takes a tenth of a second


def check_size(height: int, width: int) -> None:
    """Refuse an image without pixels, or of more than `MAX_PIXELS`.

    Raises:
        MessageError: it is one of them.
    """
    if not 0 < height * width <= MAX_PIXELS:
        raise MessageError(
            f"an image of {width} x {height} px is outside 1 to {MAX_PIXELS} px; "
            "let the camera publish a smaller one"
        )


def check(file: NDArray[np.uint8]) -> None:
    """Refuse a file (n,) uint8 that no camera makes, or that would cost too much to decode.

    Raises:
        MessageError: it is no JPEG or PNG, truncated, animated, too large, or unpacks to more
            than its pixels.
    """
    if len(file) > MAX_FILE_BYTES:
        raise MessageError(
            f"a compressed image of {len(file)} bytes is larger than {MAX_FILE_BYTES}"
        )
    data = file.tobytes()
    if data.startswith(PNG):
        _check_png(data)
    elif data.startswith(JPEG):
        _check_jpeg(data)
    else:
        raise MessageError(
            f"a compressed image must be JPEG or PNG; found {len(data)} bytes that begin "
            f"{data[:8]!r}"
        )


def _check_jpeg(data: bytes) -> None:
    """Its frame header is found by walking the segments before it."""
    if JPEG_END not in data[-END_SEARCH:]:  # would decode to a picture whose rest is grey
        raise _truncated(data)
    scans = data.count(JPEG_SCAN)
    if scans > MAX_SCANS:
        raise MessageError(f"a JPEG image of {scans} scans is no camera's; expected {MAX_SCANS}")
    at = 2
    for _ in range(MAX_PARTS):
        if at + 9 > len(data) or data[at] != 0xFF:
            break
        marker = data[at + 1]
        length, _, height, width = struct.unpack(">HBHH", data[at + 2 : at + 9])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            check_size(height, width)
            return
        at += 1 if marker == 0xFF else 2 + length  # markers may be preceded by fill bytes
    raise MessageError("a JPEG image has no frame header; it is damaged")


def _check_png(data: bytes) -> None:
    """Every chunk must be there: OpenCV reserves what one declares."""
    at, names, pixels = len(PNG), [], []
    for _ in range(MAX_PARTS):
        length = int.from_bytes(data[at : at + 4])
        names.append(data[at + 4 : at + 8])
        if names[-1] == PNG_DATA:
            pixels.append(data[at + 8 : at + 8 + length])
        at += 12 + length  # length, name and checksum are 4 bytes each
        if at > len(data) or names[-1] == PNG_END:
            break
    if at > len(data) or names[-1] != PNG_END:
        raise _truncated(data)
    if names[0] != PNG_HEADER or names.count(PNG_HEADER) > 1 or PNG_ANIMATED in names:
        raise MessageError("a PNG image has several headers or pictures; expected one of each")
    width, height = struct.unpack(">II", data[16:24])
    check_size(height, width)
    compressed = sum(map(len, pixels))
    if len(data) - compressed > HARMLESS_BYTES + 12 * len(names):
        raise MessageError("a PNG image holds more beside its pixels than any camera's")
    if compressed > HARMLESS_BYTES and _inflates_beyond(pixels, 9 * (width + 1) * (height + 8)):
        raise MessageError(f"a PNG image holds more than its {width} x {height} px; it is damaged")


def _inflates_beyond(parts: Sequence[bytes], limit: int) -> bool:
    """Whether deflated data, in parts, holds more than so many bytes."""
    inflater = zlib.decompressobj()
    for part in parts:
        for start in range(0, len(part), HARMLESS_BYTES):
            piece = part[start : start + HARMLESS_BYTES]
            while piece and not inflater.eof:
                try:
                    limit -= len(inflater.decompress(piece, 2**20))
                except zlib.error as error:
                    raise MessageError(f"a PNG image is damaged: {error}") from error
                if limit < 0:
                    return True
                piece = inflater.unconsumed_tail
    return False


def _truncated(data: bytes) -> MessageError:
    return MessageError(f"a compressed image of {len(data)} bytes is truncated or damaged")
