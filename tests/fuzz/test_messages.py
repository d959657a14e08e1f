"""Messages in CDR, up to what the runtime makes of them."""

import numpy as np
import pytest

from cbe.camera import CameraModel
from cbe.images import compress, decode_image, raw
from cbe.messages import (
    MESSAGE_TYPES,
    CameraInfo,
    CompressedImage,
    Image,
    LaserScan,
    Odometry,
    Twist,
    TwistStamped,
)
from cbe.rays import resample, scan_message

from .harness import SEED
from .mutate import mutants

STAMP_NS = 1_700_000_000_123_456_789
PICTURE = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
EXAMPLES = {
    Twist: [Twist.planar(0.4, -0.2)],
    TwistStamped: [TwistStamped(STAMP_NS, "base_link", Twist.planar(0.4, -0.2))],
    Odometry: [Odometry.planar(STAMP_NS, (1.0, -2.0, 3.0), 0.5, 0.1)],
    CompressedImage: [compress(PICTURE, STAMP_NS)],
    Image: [raw(PICTURE, STAMP_NS)],
    CameraInfo: [
        CameraInfo.of(CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0), STAMP_NS),
        CameraInfo.of(
            CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, "fisheye", (0.1,) * 4), STAMP_NS
        ),
    ],
    LaserScan: [
        scan_message(np.linspace(0.5, 4.0, 240), STAMP_NS),
        LaserScan(STAMP_NS, "", 0.0, 0.0, 0.0, 0.1, 8.0, np.ones(2, np.float32)),
    ],
}
TOKENS = [b"rgb8", b"bgra8", b"mono8", b"plumb_bob\0", b"equidistant\0", b"\xff\xfe\0", b"\0\0\0\1"]
TOKENS += [b"\0\1\0\0", b"\0\0\0\0", b"\0\x0b\0\0"]  # headers: little, big endian, XCDR2


def use(message):
    """What the runtime does with a message before it relies on it."""
    if isinstance(message, CompressedImage | Image):
        decode_image(message)
    elif isinstance(message, LaserScan):
        ranges_m = resample(message)
        assert not (ranges_m < 0.0).any()
    elif isinstance(message, CameraInfo):
        message.camera()
    elif isinstance(message, Odometry):
        assert len(message.pose) == 3


def test_every_type_is_attacked():
    assert {kind.cls for kind in MESSAGE_TYPES.values()} == set(EXAMPLES)


@pytest.mark.parametrize("kind", EXAMPLES, ids=lambda kind: kind.__name__)
def test_hostile_message_is_refused_soon_and_small(fuzzed, kind):
    valid = [message.to_cdr() for message in EXAMPLES[kind]]
    others = [each.to_cdr() for messages in EXAMPLES.values() for each in messages]

    def read(data):
        message = kind.from_cdr(data)
        message.to_cdr()
        use(message)

    for data in valid[:1]:
        read(data)
    name = f"messages-{kind.__name__}"
    report = fuzzed(name, read, valid[:1], mutants(valid, SEED, [*TOKENS, *others]), attacks=others)
    assert 0 < report.accepted < report.inputs
