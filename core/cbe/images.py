"""Image messages to and from RGB arrays; hostile files are refused before they are unpacked."""

import struct

import numpy as np
from numpy.typing import NDArray

from cbe.errors import MessageError
from cbe.messages import CompressedImage, Image

Pixels = NDArray[np.uint8]

MAX_PIXELS = 2**24
JPEG, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
PNG, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
END_SEARCH = 64  # some encoders pad the file
CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}


def decode_image(message: CompressedImage | Image) -> Pixels:
    """The picture as (height, width, 3) uint8 RGB.

    Raises MessageError for an unknown encoding, sizes that contradict each other, a damaged or
    truncated file, or more than `MAX_PIXELS`.
    """
    return _decompress(message) if isinstance(message, CompressedImage) else _unpack(message)


def compress(
    image: Pixels, stamp_ns: int, frame_id: str = "camera_optical", quality: int = 90
) -> CompressedImage:
    """A JPEG message of an image (height, width, 3) uint8 RGB."""
    import cv2

    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return CompressedImage(stamp_ns, frame_id, "jpeg", np.asarray(data, np.uint8).reshape(-1))


def raw(image: Pixels, stamp_ns: int, frame_id: str = "camera_optical") -> Image:
    """An rgb8 message of an image (height, width, 3) uint8 RGB."""
    height, width, _ = image.shape
    data = np.ascontiguousarray(image).reshape(-1)  # (h, w, 3) to (h * w * 3,)
    return Image(stamp_ns, frame_id, height, width, "rgb8", 3 * width, data)


def _decompress(message: CompressedImage) -> Pixels:
    import cv2

    data = message.data.tobytes()
    height, width = _file_size(data)
    if not 0 < height * width <= MAX_PIXELS:
        raise MessageError(f"an image of {width} x {height} px is outside 1 to {MAX_PIXELS} px")
    try:
        # Orientation tags are for photographs; the calibration is of the sensor's pixels.
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        bgr = cv2.imdecode(message.data, flags)
    except cv2.error as error:
        raise MessageError(f"a compressed image does not decode: {error}") from error
    if bgr is None:
        raise MessageError(f"a compressed image of {len(data)} bytes does not decode")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def _file_size(data: bytes) -> tuple[int, int]:
    """Height and width that a JPEG or PNG file declares."""
    if data.startswith(PNG) and data[12:16] == b"IHDR" and len(data) >= 24:
        _require_end(data, PNG_END)
        width, height = struct.unpack(">II", data[16:24])
        return height, width
    if data.startswith(JPEG):
        _require_end(data, JPEG_END)
        return _jpeg_size(data)
    raise MessageError(
        f"a compressed image must be JPEG or PNG; found {len(data)} bytes that begin {data[:8]!r}"
    )


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """From the frame header, found by walking the segments before it."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        length, _, height, width = struct.unpack(">HBHH", data[at + 2 : at + 9])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return height, width
        at += 1 if marker == 0xFF else 2 + length  # markers may be preceded by fill bytes
    raise MessageError("a JPEG image has no frame header; it is damaged")


def _require_end(data: bytes, end: bytes) -> None:
    """A truncated file would decode to a picture whose rest is grey."""
    if end not in data[-END_SEARCH:]:
        raise MessageError(f"a compressed image of {len(data)} bytes is truncated")


def _unpack(message: Image) -> Pixels:
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        raise MessageError(
            f"image encoding {message.encoding!r} is not supported; known: {list(CHANNELS)}"
        )
    height, width, step = message.height, message.width, message.step
    if not 0 < height * width <= MAX_PIXELS:
        raise MessageError(f"an image of {width} x {height} px is outside 1 to {MAX_PIXELS} px")
    if step < width * channels or len(message.data) != height * step:
        raise MessageError(
            f"an image of {width} x {height} px in {message.encoding} does not fit step {step} "
            f"and {len(message.data)} bytes"
        )
    rows = message.data.reshape(height, step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    order = (2, 1, 0) if message.encoding.startswith("bgr") else (0, 1, 2)
    return np.ascontiguousarray(pixels[:, :, order])
