"""Pictures: JPEG, PNG and raw."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from cbe.errors import MessageError
from cbe.imagefile import MAX_FILE_BYTES, MAX_PIXELS
from cbe.images import decode_image
from cbe.messages import CompressedImage, Image
from cbe_runtime.view import View

from .harness import SEED
from .mutate import mutants

PICTURE = np.random.default_rng(0).integers(0, 256, (12, 16, 4), np.uint8)
PNG = b"\x89PNG\r\n\x1a\n"


def encoded(suffix, image, *flags):
    return cv2.imencode(suffix, image, flags)[1].tobytes()


JPEGS = [
    encoded(".jpg", PICTURE[:, :, :3]),
    encoded(".jpg", PICTURE[:, :, 0]),
    encoded(".jpg", PICTURE[:, :, :3], cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    encoded(".jpg", PICTURE[:, :, :3], cv2.IMWRITE_JPEG_RST_INTERVAL, 1),
]
MARKERS = [b"\xff" + bytes([code]) for code in (*range(0xC0, 0xE3), 0xEE, 0xFE)]


def chunk(name, content):
    return (
        struct.pack(">I", len(content)) + name + content
        + struct.pack(">I", zlib.crc32(name + content))
    )  # fmt: skip


def png(width, height, depth, colour, rows, interlaced=0, extra=b""):
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlaced)
    return b"".join(
        [
            PNG,
            chunk(b"IHDR", header),
            extra,
            chunk(b"IDAT", zlib.compress(rows, 9)),
            chunk(b"IEND", b""),
        ]
    )


PALETTE = chunk(b"PLTE", bytes(range(48))) + chunk(b"tRNS", bytes(16))
PROFILE = chunk(b"iCCP", b"p\0\0" + zlib.compress(bytes(300)))
ANIMATED = chunk(b"acTL", struct.pack(">II", 2, 0)) + chunk(
    b"fcTL", struct.pack(">IIIIIHHBB", 0, 4, 3, 0, 0, 1, 1, 0, 0)
)
PNGS = [
    encoded(".png", PICTURE[:, :, :3]),
    encoded(".png", PICTURE),
    png(4, 3, 16, 6, bytes(3 * 33)),
    png(4, 3, 4, 3, bytes(3 * 3), extra=PALETTE),
    png(4, 3, 8, 2, bytes(3 * 26), interlaced=1, extra=PROFILE),
    png(4, 3, 8, 2, bytes(3 * 13), extra=ANIMATED),
]


def mended(data):
    """A mutant PNG whose checksums are right, so that its content is read."""
    out, at = [data[:8]], 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4])
        body = data[at + 4 : at + 8 + length]
        out.append(data[at : at + 4] + body + zlib.crc32(body).to_bytes(4))
        at += 12 + length
    return b"".join(out) + data[at:]


def repacked(data, rng):
    """A PNG of these rows."""
    return png(4, 3, rng.choice((1, 2, 4, 8, 16)), rng.choice((0, 2, 3, 4, 6)), data)


def compressed(data):
    return decode_image(CompressedImage(0, "", "", np.frombuffer(data, np.uint8)))


def test_hostile_jpeg_is_refused_soon_and_small(fuzzed):
    exif = b"\xff\xe1\0\x10Exif\0\0II*\0\x08\0\0\0"
    report = fuzzed(
        "images-jpeg",
        compressed,
        JPEGS,
        mutants(JPEGS, SEED, [*MARKERS, exif]),
        attacks=jpeg_attacks(),
    )
    assert 0 < report.accepted < report.inputs


def jpeg_attacks():
    """Few bytes that ask for many pixels, many passes or many steps."""
    for whole in JPEGS:
        at = next(
            whole.find(bytes([0xFF, code])) for code in (0xC0, 0xC2) if bytes([0xFF, code]) in whole
        )
        for height, width in ((65_535, 65_535), (1, 65_535), (65_535, 1), (2048, 2048), (0, 9)):
            yield whole[: at + 5] + struct.pack(">HH", height, width) + whole[at + 9 :]
    progressive = JPEGS[2]
    at = progressive.find(b"\xff\xc2")
    large = bytearray(progressive)
    large[at + 5 : at + 9] = struct.pack(">HH", 2048, 2048)
    scan = progressive.rfind(b"\xff\xda")
    for count in (100, 3_000):
        yield bytes(large[:-2]) + progressive[scan:-2] * count + b"\xff\xd9"
    yield b"\xff\xd8" + b"\xff" * 1_000_000 + b"\xff\xd9"
    yield b"\xff\xd8" + b"\xff\xe0\0\2" * 1_000_000 + b"\xff\xd9"


def test_hostile_png_is_refused_soon_and_small(fuzzed):
    def hostile():
        for data in mutants(PNGS, SEED, [PALETTE, PROFILE, ANIMATED]):
            yield data
            yield mended(data)

    report = fuzzed("images-png", compressed, PNGS[:-1], hostile(), attacks=png_attacks())
    assert 0 < report.accepted < report.inputs


def png_attacks():
    side = int(MAX_PIXELS**0.5)
    yield png(side, side, 8, 2, bytes((3 * side + 1) * side))
    yield png(side, side, 16, 6, bytes((8 * side + 1) * side))
    yield png(side, side, 16, 6, bytes((8 * side + 1) * side), interlaced=1)
    yield png(2**31 - 1, 1, 8, 2, bytes(99))
    yield png(MAX_PIXELS, 1, 8, 2, bytes(3 * MAX_PIXELS + 1))
    yield png(1, MAX_PIXELS, 8, 2, bytes(4 * MAX_PIXELS))
    yield png(4, 3, 8, 2, bytes(2**26))  # far more rows than declared
    bomb = zlib.compress(bytes(2**26), 9)
    for name, head in ((b"iCCP", b"p\0\0"), (b"zTXt", b"t\0\0"), (b"iTXt", b"t\0\1\0\0\0")):
        yield png(4, 3, 8, 2, bytes(39), extra=chunk(name, head + bomb) * 20)
    yield png(4, 3, 8, 2, bytes(39), extra=chunk(b"tEXt", b"k\0v") * 100_000)
    frames = struct.pack(">II", 1000, 0)
    for width, height in ((4, 3), (65_535, 65_535), (2**31 - 1, 2**31 - 1)):
        control = struct.pack(">IIIIIHHBB", 0, width, height, 0, 0, 1, 1, 0, 0)
        extra = chunk(b"acTL", frames) + chunk(b"fcTL", control)
        yield png(4, 3, 8, 2, bytes(39), extra=extra)


def test_hostile_raw_image_is_refused_soon_and_small(fuzzed):
    """The fields come first in each input: height, width, step, encoding's number; then pixels."""
    names = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8", "mono16", "", "x" * 5_000, "\0")
    head = struct.Struct("<IIIB")
    view = View()

    def read(data):
        height, width, step, which = head.unpack(data[: head.size].ljust(head.size, b"\0"))
        pixels = np.frombuffer(data[head.size :], np.uint8)
        message = Image(0, "", height, width, names[which % len(names)], step, pixels)
        assert decode_image(message).shape == (height, width, 3)

    valid = [
        head.pack(12, 16, 16 * size, which) + PICTURE.tobytes()[: 12 * 16 * size]
        for which, size in enumerate((3, 3, 4, 4, 1))
    ]
    side = int(MAX_PIXELS**0.5)
    attacks = [head.pack(side, side, 4 * side, 2) + bytes(4 * MAX_PIXELS)]
    attacks += [head.pack(side, side, 3 * side, 1) + bytes(3 * MAX_PIXELS)]
    attacks += [head.pack(2**32 - 1, 2**32 - 1, 2**32 - 1, 0), head.pack(2**31, 2, 2**31, 4)]
    report = fuzzed("images-raw", read, valid, mutants(valid, SEED), attacks=attacks)
    assert 0 < report.accepted < report.inputs
    assert view.camera is None


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (PNGS[-1], "several headers"),
        (PNGS[0][:8] + PNGS[0][8:33] * 2 + PNGS[0][33:], "several headers"),
        (PNGS[0][:33] + b"\xff" * 4 + PNGS[0][37:], "truncated"),
        (png(4, 3, 8, 2, bytes(2**27)), "more than its 4 x 3 px"),
        (png(4, 3, 8, 2, bytes(39), extra=chunk(b"zTXt", bytes(10**5))), "beside its pixels"),
        (JPEGS[2][:-2] + b"\xff\xda" * 40 + b"\xff\xd9", "scans"),
        (JPEGS[0] + bytes(MAX_FILE_BYTES), "larger than"),
    ],
)
def test_picture_that_no_camera_makes_is_refused(data, reason):
    with pytest.raises(MessageError, match=reason):
        compressed(data)
