"""Image messages to and from RGB arrays; hostile files are refused before they are unpacked."""

import numpy as np
from numpy.typing import NDArray

from cbe import imagefile
from cbe.errors import MessageError
from cbe.messages import CompressedImage, Image

Pixels = NDArray[np.uint8]

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}


def load_decoder() -> None:
    """Load OpenCV now, where the first picture must not wait 30 ms for it."""
    import cv2  # noqa: F401


def decode_image(message: CompressedImage | Image) -> Pixels:
    """The picture as (height, width, 3) uint8 RGB.

    Raises MessageError for an unknown encoding, sizes that contradict each other, a damaged or
    truncated file, or more than `imagefile.MAX_PIXELS`.
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

    imagefile.check(message.data)
    try:
        # Orientation tags are for photographs; the calibration is of the sensor's pixels.
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        rgb = cv2.imdecode(message.data, flags)
    except cv2.error as error:
        raise MessageError(f"a compressed image does not decode: {error}") from error
    if rgb is None:
        raise MessageError(f"a compressed image of {len(message.data)} bytes does not decode")
    return np.asarray(rgb, np.uint8)


def _unpack(message: Image) -> Pixels:
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        raise MessageError(
            f"image encoding {message.encoding[:32]!r} is not supported; known: {list(CHANNELS)}"
        )
    height, width, step = message.height, message.width, message.step
    imagefile.check_size(height, width)
    if step < width * channels or len(message.data) != height * step:
        raise MessageError(
            f"an image of {width} x {height} px in {message.encoding} does not fit step {step} "
            f"and {len(message.data)} bytes"
        )
    rows = message.data.reshape(height, step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    rgb = pixels[:, :, 2::-1] if message.encoding.startswith("bgr") else pixels[:, :, :3]
    return np.ascontiguousarray(rgb)
