import logging

import numpy as np
import pytest
from mcap.reader import make_reader

from cbe.errors import RecordingError
from cbe.images import compress
from cbe.messages import CompressedImage, LaserScan
from cbe.rays import scan_message
from cbe_runtime import mcapfile
from cbe_runtime.mcapfile import Recorded, Recorder

CAMERA = "/camera/image_raw/compressed"


def messages(count=20):
    rng = np.random.default_rng(0)
    for step in range(count):
        stamp = 1_000_000_000 + step * 100_000_000
        image = rng.integers(0, 256, (48, 64, 3), np.uint8)
        yield Recorded(CAMERA, CompressedImage.TYPE, compress(image, stamp).to_cdr(), stamp)
        scan = scan_message(rng.random(240), stamp)
        yield Recorded("/scan", LaserScan.TYPE, scan.to_cdr(), stamp)


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "drive.mcap"
    with Recorder(path) as recorder:
        for message in messages(200):
            recorder.write(message)
    return path


def test_messages_return_as_they_were_written(recording):
    assert list(mcapfile.read(recording)) == list(messages(200))


def test_file_is_an_indexed_ros2_recording(recording):
    with recording.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        schemas = {schema.name: schema for schema in reader.get_summary().schemas.values()}
    assert schemas[LaserScan.TYPE].encoding == "ros2msg"
    assert b"float32[] ranges" in schemas[LaserScan.TYPE].data


def test_truncated_recording_yields_what_it_holds(recording, tmp_path, caplog):
    whole = recording.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    with caplog.at_level(logging.WARNING):
        found = list(mcapfile.read(cut))
    assert 100 < len(found) < 400
    assert found == list(messages(200))[: len(found)]
    assert "truncated" in caplog.text


def test_flipped_byte_ends_the_stream_with_a_warning(recording, tmp_path, caplog):
    whole = bytearray(recording.read_bytes())
    whole[len(whole) // 2] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(whole)
    found = list(mcapfile.read(damaged))
    assert found == list(messages(200))[: len(found)]
    assert "damaged" in caplog.text


@pytest.mark.parametrize("content", [b"", b"nothing like an mcap", b"\x89MCAP0\r\n" + bytes(20)])
def test_file_that_is_no_recording_is_refused(tmp_path, content):
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match=r"x\.mcap"):
        list(mcapfile.read(tmp_path / "x.mcap"))


def test_recording_without_known_messages_is_refused(tmp_path):
    Recorder(tmp_path / "x.mcap").close()
    with pytest.raises(RecordingError, match="known type"):
        list(mcapfile.read(tmp_path / "x.mcap"))


def test_missing_recording_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.mcap"):
        list(mcapfile.read(tmp_path / "none.mcap"))


def test_unwritable_recording_is_named(tmp_path):
    with pytest.raises(RecordingError, match="cannot write"):
        Recorder(tmp_path / "no" / "x.mcap")
