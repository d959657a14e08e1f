"""Messages, their CDR, pictures and scans."""

import math
import subprocess
import sys
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from cbe.camera import CameraModel
from cbe.errors import MessageError
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

STAMP_NS = 1_700_000_000_123_456_789

number = st.floats(allow_nan=False, allow_infinity=False)
single = st.floats(width=32, allow_nan=False)
vector = st.tuples(number, number, number)
stamp = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
name = st.sampled_from(["", "base_link", "caméra/🤖", "x" * 63])
pixels = st.binary(max_size=50).map(lambda data: np.frombuffer(data, np.uint8))
ranges = st.lists(st.floats(width=32), max_size=20).map(lambda data: np.array(data, np.float32))
uint32 = st.integers(0, 2**32 - 1)
twist = st.builds(Twist, vector, vector)
messages = st.one_of(
    twist,
    st.builds(TwistStamped, stamp, name, twist),
    st.builds(Odometry, stamp, name, name, vector, st.tuples(*[number] * 4), twist),
    st.builds(CompressedImage, stamp, name, name, pixels),
    st.builds(Image, stamp, name, uint32, uint32, name, uint32, pixels),
    st.builds(
        CameraInfo, stamp, name, uint32, uint32, name,
        st.lists(number, max_size=8).map(tuple), st.tuples(*[number] * 9),
    ),
    st.builds(LaserScan, stamp, name, *[single] * 5, ranges, single, single, ranges),
)  # fmt: skip
EXAMPLES = [
    Twist.planar(0.4, -0.2),
    TwistStamped(STAMP_NS, "base_link", Twist.planar(0.4, -0.2)),
    Odometry.planar(STAMP_NS, (1.0, -2.0, 3.0), 0.5, 0.1),
    compress(np.full((12, 16, 3), 90, np.uint8), STAMP_NS),
    raw(np.zeros((3, 4, 3), np.uint8), STAMP_NS),
    CameraInfo.of(CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0), STAMP_NS),
    scan_message(np.linspace(0.5, 4.0, 240), STAMP_NS),
]
example = st.sampled_from(EXAMPLES)


def same(first: Any, second: Any) -> bool:
    return type(first) is type(second) and all(
        np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b
        for a, b in (
            (getattr(first, item.name), getattr(second, item.name)) for item in fields(first)
        )
    )


@settings(max_examples=60)
@given(messages)
def test_cdr_round_trip_gives_the_same_message(message: Any) -> None:
    assert same(type(message).from_cdr(message.to_cdr()), message)


@given(example, st.binary(max_size=200))
def test_any_bytes_give_a_message_or_a_message_error(message: Any, data: bytes) -> None:
    for head in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        try:
            type(message).from_cdr(head + data)
        except MessageError:
            continue


@given(example, st.data())
def test_flipped_bytes_give_a_message_or_a_message_error(message: Any, data: Any) -> None:
    damaged = bytearray(message.to_cdr())
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, min(len(damaged), 120) - 1))] = data.draw(
            st.integers(0, 255)
        )
    try:
        received = type(message).from_cdr(bytes(damaged))
        if isinstance(received, CompressedImage | Image):
            decode_image(received)
        if isinstance(received, LaserScan):
            resample(received)
    except MessageError:
        return


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_truncated_message_is_refused(message: Any) -> None:
    whole = message.to_cdr()
    for length in {*range(0, len(whole) - 1, max(1, len(whole) // 50)), len(whole) - 1}:
        with pytest.raises(MessageError):
            type(message).from_cdr(whole[:length])


def test_big_endian_message_is_read() -> None:
    from cbe.codec import _typestore

    message = EXAMPLES[1]
    big = _typestore().serialize_cdr(message._to_ros(), message.TYPE, little_endian=False)
    assert TwistStamped.from_cdr(big) == message


@pytest.mark.parametrize(
    "message",
    [
        TwistStamped(2**63, "", Twist()),
        Image(0, "", -1, 4, "rgb8", 12, np.zeros(0, np.uint8)),
        CompressedImage(0, "", "jpeg", b"text"),  # type: ignore[arg-type]
        CameraInfo(0, "", 1, 1, "plumb_bob", (), (1.0,)),
    ],
)
def test_value_that_does_not_fit_its_field_is_refused(message: Any) -> None:
    with pytest.raises(MessageError):
        message.to_cdr()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_twist_that_is_not_finite_is_refused_on_both_sides(bad: float) -> None:
    with pytest.raises(MessageError):
        Twist.planar(bad, 0.0)
    good = Twist.planar(0.123, 0.0).to_cdr()
    wire = good.replace(np.float64(0.123).tobytes(), np.float64(bad).tobytes())
    assert wire != good
    with pytest.raises(MessageError):
        Twist.from_cdr(wire)


def test_hashes_are_those_of_a_ros_release() -> None:
    # As the complete type stores of ROS 2 Humble and Jazzy in rosbags give them.
    assert {kind.name: kind.type_hash[:16] for kind in MESSAGE_TYPES.values()} == {
        "sensor_msgs/msg/CompressedImage": "RIHS01_156407715",
        "sensor_msgs/msg/Image": "RIHS01_d31d41a9a",
        "sensor_msgs/msg/CameraInfo": "RIHS01_b3dfd68ff",
        "sensor_msgs/msg/LaserScan": "RIHS01_64c191398",
        "nav_msgs/msg/Odometry": "RIHS01_3cc97dc7f",
        "geometry_msgs/msg/TwistStamped": "RIHS01_5f0fcd4f8",
        "geometry_msgs/msg/Twist": "RIHS01_9c45bf16f",
    }


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_schema_text_lets_another_reader_decode_the_message(message: Any) -> None:
    kind = MESSAGE_TYPES[message.TYPE]
    schema = Schema(id=1, data=kind.definition.encode(), encoding="ros2msg", name=kind.name)
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    decoded = decode(message.to_cdr())
    if isinstance(message, Twist):
        assert decoded.linear.x == 0.4
    else:
        assert decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec == STAMP_NS


def test_planar_odometry_gives_its_pose_back() -> None:
    assert Odometry.planar(0, (1.0, -2.0, 3.0), 0.5, 0.1).pose == pytest.approx((1.0, -2.0, 3.0))


def test_camera_info_gives_its_camera_back() -> None:
    camera = CameraModel(64, 48, 20.0, 21.0, 31.0, 25.0, "fisheye", (0.1, 0.0, 0.0, 0.0))
    assert CameraInfo.from_cdr(CameraInfo.of(camera, 0).to_cdr()).camera() == camera


def test_jpeg_keeps_colours_in_their_places() -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    image[:32, :, 0] = 250
    image[32:, :, 2] = 250
    decoded = decode_image(compress(image, STAMP_NS))
    assert decoded.shape == (48, 64, 3)
    assert np.abs(decoded.astype(int) - image).mean() < 3.0


def test_png_is_read_without_loss() -> None:
    import cv2

    image = np.random.default_rng(0).integers(0, 256, (9, 7, 3), np.uint8)
    png = cv2.imencode(".png", image[:, :, ::-1])[1].reshape(-1)
    assert np.array_equal(decode_image(CompressedImage(0, "", "png", png)), image)


@pytest.mark.parametrize(
    ("encoding", "pixel", "rgb"),
    [
        ("rgb8", (1, 2, 3), (1, 2, 3)),
        ("bgr8", (1, 2, 3), (3, 2, 1)),
        ("rgba8", (1, 2, 3, 9), (1, 2, 3)),
        ("bgra8", (1, 2, 3, 9), (3, 2, 1)),
        ("mono8", (7,), (7, 7, 7)),
    ],
)
def test_raw_image_with_padded_rows_is_unpacked(
    encoding: str, pixel: tuple[int, ...], rgb: tuple[int, ...]
) -> None:
    row = bytes(pixel) * 5 + b"\xff" * 3
    data = np.frombuffer(row * 4, np.uint8)
    image = decode_image(Image(0, "", 4, 5, encoding, len(row), data))
    assert image.shape == (4, 5, 3)
    assert (image == rgb).all()


def jpeg(data: bytes) -> CompressedImage:
    return CompressedImage(0, "", "jpeg", np.frombuffer(data, np.uint8))


WHOLE = EXAMPLES[3].data.tobytes()  # type: ignore[attr-defined]
BOMB = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (2**30).to_bytes(4, "big") * 2 + b"IEND"


@pytest.mark.parametrize(
    "message",
    [
        jpeg(b""),
        jpeg(b"GIF89a not for us"),
        jpeg(WHOLE[: len(WHOLE) // 2]),
        jpeg(WHOLE[:20] + b"\xff\xd9"),
        jpeg(b"\xff\xd8\xff" + b"\0" * 50 + b"\xff\xd9"),
        jpeg(BOMB),
        jpeg(BOMB[:20]),
        Image(0, "", 4, 5, "32FC1", 20, np.zeros(80, np.uint8)),
        Image(0, "", 4, 5, "rgb8", 14, np.zeros(56, np.uint8)),
        Image(0, "", 4, 5, "rgb8", 15, np.zeros(59, np.uint8)),
        Image(0, "", 0, 5, "rgb8", 15, np.zeros(0, np.uint8)),
        Image(0, "", 2**31, 2**31, "mono8", 2**31, np.zeros(9, np.uint8)),
    ],
)
def test_damaged_picture_is_refused(message: Any) -> None:
    with pytest.raises(MessageError):
        decode_image(message)


def lidar(
    count: int, low_deg: float, high_deg: float, ranges_m: Any, least_m: float = 0.1
) -> LaserScan:
    low, high = np.float32(np.radians([low_deg, high_deg]))
    step = np.float32((high - low) / (count - 1))
    values = np.broadcast_to(np.asarray(ranges_m, np.float32), count)
    return LaserScan(
        0, "laser", float(low), float(high), float(step), least_m, 12.0, values
    )  # fmt: skip


RAYS_DEG = np.linspace(-120.0, 120.0, 240)


def test_scan_of_the_same_robot_is_kept_as_it_is() -> None:
    ranges_m = np.random.default_rng(0).uniform(0.3, 7.9, 240).astype(np.float32)
    ranges_m[7] = np.inf
    scan = LaserScan.from_cdr(scan_message(ranges_m, STAMP_NS).to_cdr())
    assert np.array_equal(resample(scan), ranges_m)


@pytest.mark.parametrize(
    ("count", "low_deg", "high_deg"),
    [(720, -180.0, 179.5), (360, 0.0, 359.0), (1081, -135.0, 135.0), (480, 120.0, -120.0)],
    ids=["full turn", "from ahead", "270 deg", "clockwise"],
)
def test_any_lidar_sees_the_same_wall(count: int, low_deg: float, high_deg: float) -> None:
    angle = np.radians(np.linspace(low_deg, high_deg, count))
    offset = (angle - 0.7 + np.pi) % (2.0 * np.pi) - np.pi
    scan = lidar(count, low_deg, high_deg, 2.0 + 0.5 * np.abs(offset))  # 2 m at 0.7 rad
    ours = resample(scan)
    expected = 2.0 + 0.5 * np.abs(np.radians(RAYS_DEG) - 0.7)
    np.testing.assert_allclose(ours, expected, atol=0.5 * np.radians(1.1))


def test_thin_obstacle_between_rays_is_not_lost() -> None:
    ranges_m = np.full(2401, 5.0)
    ranges_m[1203] = 1.0
    assert resample(lidar(2401, -120.0, 120.0, ranges_m)).min() == 1.0


def test_coarse_lidar_leaves_no_gaps() -> None:
    assert (resample(lidar(121, -120.0, 120.0, 3.0)) == 3.0).all()


def test_directions_that_no_beam_points_to_are_nan() -> None:
    ours = resample(lidar(181, -90.0, 90.0, 3.0))
    assert np.array_equal(np.isnan(ours), np.abs(RAYS_DEG) > 90.5)


@pytest.mark.parametrize(
    ("measured", "meant"),
    [
        (np.nan, np.nan),
        (0.05, np.nan),
        (0.0, np.nan),
        (-1.0, np.nan),
        (-np.inf, 0.1),
        (np.inf, np.inf),
        (11.0, np.inf),
        (3.0, 3.0),
    ],
)
def test_range_is_read_as_ros_means_it(measured: float, meant: float) -> None:
    ours = resample(lidar(240, -120.0, 120.0, measured))
    assert np.array_equal(ours, np.full(240, meant, np.float32), equal_nan=True)


@pytest.mark.parametrize(
    "scan",
    [
        LaserScan(0, "", -2.0, 2.0, 0.0, 0.1, 8.0, np.ones(41, np.float32)),
        LaserScan(0, "", -2.0, 2.0, 0.1, 0.1, 8.0, np.empty(0, np.float32)),
        LaserScan(0, "", math.nan, 2.0, 0.1, 0.1, 8.0, np.ones(41, np.float32)),
        LaserScan(0, "", -200.0, 200.0, 10.0, 0.1, 8.0, np.ones(41, np.float32)),
        LaserScan(0, "", -2.0, 1.0, 0.1, 0.1, 8.0, np.ones(41, np.float32)),
        LaserScan(0, "", -2.0, 2.0, 0.1, 9.0, 8.0, np.ones(41, np.float32)),
        LaserScan(0, "", -2.0, 2.0, 0.1, math.nan, 8.0, np.ones(41, np.float32)),
    ],
)
def test_scan_that_makes_no_sense_is_refused(scan: LaserScan) -> None:
    with pytest.raises(MessageError):
        resample(scan)


def test_only_types_in_use_are_loaded() -> None:
    code = (
        "import sys; from cbe.messages import Twist; Twist.planar(1, 0).to_cdr();"
        "print([name for name in sys.modules if name.startswith('rosbags.typesys.stores.')])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
