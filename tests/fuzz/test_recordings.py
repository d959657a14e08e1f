"""Recordings (MCAP), up to the views that teaching and replaying make of them."""

import random
import struct
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard

from cbe.camera import CameraModel
from cbe.errors import RecordingError
from cbe.images import compress
from cbe.messages import CameraInfo, CompressedImage, LaserScan
from cbe.rays import scan_message
from cbe.robot import Robot
from cbe_runtime import mcapfile
from cbe_runtime.drive import RecordedDrive
from cbe_runtime.mcapfile import Recorded, Recorder
from cbe_runtime.replay import decisions

from .harness import SEED
from .mutate import mutants

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 3, 4, 5, 6, 15


def messages():
    rng = np.random.default_rng(0)
    camera = CameraModel(64, 48, 20.0, 19.0, 32.0, 24.0)
    for step in range(3):
        stamp = 1_000_000_000 + step * 100_000_000
        picture = rng.integers(0, 256, (48, 64, 3), np.uint8)
        yield Recorded("/a/info", CameraInfo.TYPE, CameraInfo.of(camera, stamp).to_cdr(), stamp)
        yield Recorded("/a/b", CompressedImage.TYPE, compress(picture, stamp).to_cdr(), stamp)
        scan = scan_message(rng.random(240), stamp)
        yield Recorded("/scan", LaserScan.TYPE, scan.to_cdr(), stamp)


def text(value):
    return struct.pack("<I", len(value)) + value


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def schema(number, name):
    return record(SCHEMA, struct.pack("<H", number) + text(name) + text(b"ros2msg") + text(b""))


def channel(number, topic, schema_id=1, metadata=b""):
    head = struct.pack("<HH", number, schema_id)
    return record(CHANNEL, head + text(topic) + text(b"cdr") + text(metadata))


def message(channel_id, data, time=1):
    return record(MESSAGE, struct.pack("<HIQQ", channel_id, 0, time, time) + data)


def chunk(content, compression=b"zstd", size=None, data=None, crc=None):
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    if data is None:
        pack = {b"zstd": zstandard.compress, b"lz4": lz4.frame.compress, b"": bytes}
        data = pack[compression](content)
    head = struct.pack("<QQQI", 0, 0, size, crc) + text(compression)
    return record(CHUNK, head + struct.pack("<Q", len(data)) + data)


def file(*records):
    return MAGIC + b"".join(records) + record(DATA_END, bytes(4))


IMAGE = CompressedImage.TYPE.encode()
CONTENT = b"".join(
    [
        schema(1, IMAGE),
        channel(1, b"/a/b"),
        schema(2, LaserScan.TYPE.encode()),
        channel(2, b"/scan", 2),
        *(
            message({"/a/b": 1, "/scan": 2}[each.topic], each.data, each.log_time_ns)
            for each in messages()
            if each.topic != "/a/info"
        ),
    ]
)


@pytest.fixture
def written(tmp_path):
    """A recording as ours are."""
    path = tmp_path / "written.mcap"
    with Recorder(path) as recorder:
        for each in messages():
            recorder.write(each)
    return path.read_bytes()


def hostile(written):
    """Files, and files whose chunk is whole but holds hostile records."""
    files = mutants([written, file(CONTENT), file(chunk(CONTENT))], SEED)
    contents = mutants([CONTENT], SEED + 1, [IMAGE, b"/scan", b"cdr", bytes(16)])
    rng = random.Random(SEED)
    while True:
        yield next(files)
        for _ in range(3):
            yield file(chunk(next(contents), rng.choice((b"zstd", b"lz4", b""))))


def attacks():
    """Few bytes that ask for much."""
    zeros = bytes(23 * 2**20)
    start = schema(1, IMAGE) + channel(1, b"/a/b")
    for compression in (b"zstd", b"lz4"):
        yield file(chunk(zeros, compression))
        yield file(*[chunk(zeros, compression)] * 50)
        yield file(chunk(start + message(1, zeros[:-1000]), compression))
        yield file(chunk(zeros, compression, size=10))
        yield file(chunk(b"", compression, size=2**40))
        yield file(chunk(start + message(7, b"") * 500_000, compression))
        yield file(chunk(start + record(200, b"") * 500_000, compression))
    yield file(start, *[chunk(message(1, zeros[:-1000]))] * 20)
    huge = zstandard.ZstdCompressor(write_content_size=False).compress(zeros)
    yield file(chunk(zeros, data=huge))
    yield file(chunk(b"", size=10, data=huge))
    yield file(schema(1, IMAGE), *[channel(n, b"/%d" % n * 40) for n in range(20_000)])
    many = [schema(1, IMAGE)]
    for number in range(3_000):  # each topic's first message
        many += [channel(number, b"/%d" % number), message(number, zeros[:7_000])]
    yield file(chunk(b"".join(many)))
    yield file(start, channel(2, b"/x" * 2**20))
    yield file(start, channel(2, b"/x", metadata=(text(b"") + text(b"")) * 20_000))
    nested = start
    for _ in range(2_000):
        nested = chunk(nested, b"")
    yield file(nested)
    for opcode in (9, 8, 12, 200, MESSAGE, CHUNK, SCHEMA):
        for length in (2**25, 2**31, 2**63 - 1, 2**63, 2**64 - 1):
            yield MAGIC + start + struct.pack("<BQ", opcode, length)
    both = schema(2, LaserScan.TYPE.encode()) + channel(2, b"/a/b", 2)
    picture = next(each.data for each in messages() if each.topic == "/a/b")
    scan = next(each.data for each in messages() if each.topic == "/scan")
    yield file(start, message(1, picture), both, message(2, scan))  # one topic of two types
    yield file(start, message(1, picture), message(1, picture, 2**64 - 1))


class Bystander:
    """A follower that decides nothing."""

    def start(self):
        """Nothing to do."""

    def step(self, observation, now_s):
        return observation, now_s


def test_hostile_recording_is_refused_soon_and_small(fuzzed, written, tmp_path):
    path = tmp_path / "hostile.mcap"

    def read(data):
        path.write_bytes(data)
        sum(1 for _ in mcapfile.read(path))
        drive = RecordedDrive.open(path)
        assert all(view.shape == (64, 64, 3) for view in drive.frames())
        sum(1 for _ in decisions(Bystander(), drive, Robot()))

    report = fuzzed(
        "recordings", read, [written, file(CONTENT)], hostile(written), attacks=attacks()
    )
    assert 0 < report.accepted < report.inputs


START = schema(1, IMAGE) + channel(1, b"/a/b")
ZEROS = bytes(23 * 2**20)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (file(chunk(START + message(7, b"") * 100_000)), "more records than bytes"),
        (file(*[chunk(START + message(7, ZEROS[:-999]))] * 9), "unpacks to far more"),
        (file(chunk(b"", size=2**40)), "unpacks to far more"),
        (file(chunk(bytes(25 * 2**20), b"")), "more than 25165824"),
        (file(chunk(START, size=10)), "declares more bytes"),
        (file(chunk(START, b"lz4", size=10)), "unpacks to"),
        (file(chunk(START, crc=1)), "checksum"),
        (file(chunk(START, data=b"no zstd")), "no readable"),
        (file(chunk(START, b"", data=START + b"\3")), "unpacks to"),
        (file(START, channel(2, b"/x" * 200)), "topic's name"),
        (
            file(START, record(9, b"") + struct.pack("<BQ", 9, 2**63)),
            "declares 9223372036854775808",
        ),
    ],
)
def test_few_bytes_that_ask_for_much_are_refused(tmp_path, data, reason):
    path = tmp_path / "bomb.mcap"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=reason):
        list(mcapfile.read(path))


def test_topic_of_two_types_is_read_as_its_first(tmp_path):
    pictures = [each.data for each in messages() if each.topic == "/a/b"]
    scans = [each.data for each in messages() if each.topic == "/scan"]
    other = schema(2, LaserScan.TYPE.encode()) + channel(2, b"/a/b", 2)
    path = tmp_path / "two.mcap"
    parts = [START, other]
    for picture, scan in zip(pictures, scans, strict=True):
        parts += [message(1, picture), message(2, scan)]
    path.write_bytes(file(*parts))
    drive = RecordedDrive.open(path)
    assert len(list(decisions(Bystander(), drive, Robot()))) == 3
    assert len(list(drive.frames())) == 3
