import os
import random
import re
import signal
import subprocess
import sys

import pytest

from cbe.camera import MODEL_CAMERA
from cbe.errors import RecordingError
from cbe.messages import CameraInfo
from cbe_runtime import blackbox, cli
from cbe_runtime.blackbox import Ring, RingConfig
from cbe_runtime.mcapfile import Recorded

INFO = Recorded("/camera/info", CameraInfo.TYPE, CameraInfo.of(MODEL_CAMERA, 1).to_cdr(), 1)
RNG = random.Random(0)


def decision(number, size=400):
    """Bytes that do not compress."""
    data = RNG.randbytes(size).hex()
    return Recorded(
        "/cbe/decision", "cbe/Decision", f'{{"n":{number},"x":"{data}"}}'.encode(), number
    )


def numbers(path):
    found = (re.match(rb'{"n":(\d+)', each.data) for each in blackbox.read(path))
    return [int(each[1]) for each in found if each]


def size(folder):
    return sum(path.stat().st_size for path in folder.iterdir())


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(blackbox.time, "monotonic", clock)
    monkeypatch.setattr(blackbox, "_length_s", lambda name, ended_s: blackbox.SEGMENT_S)
    return clock


def test_ring_keeps_the_last_minutes(tmp_path, clock):
    with Ring(tmp_path, RingConfig(keep_s=60.0)) as ring:
        for second in range(600):
            clock.now_s += 1.0
            ring.write(decision(second))
    kept = numbers(tmp_path)
    assert kept == list(range(kept[0], 600))
    assert 60 <= len(kept) <= 60 + 2 * blackbox.SEGMENT_S + 2
    assert ring.count == 600


def test_ring_stays_within_its_bytes(tmp_path, clock):
    allowed = 2**20
    with Ring(tmp_path, RingConfig(max_bytes=allowed)) as ring:
        for number in range(4000):
            ring.write(decision(number))
            if number % 50 == 0:
                assert size(tmp_path) <= allowed
    kept = numbers(tmp_path)
    assert kept == list(range(kept[0], 4000))
    assert size(tmp_path) > allowed // 2


def test_each_file_begins_with_the_calibration(tmp_path, clock):
    with Ring(tmp_path) as ring:
        ring.write(INFO)
        for second in range(50):
            clock.now_s += 1.0
            ring.write(decision(second))
    files = blackbox.segments(tmp_path)
    assert len(files) == 3
    for path in files:
        assert next(blackbox.read(path)).type_name == CameraInfo.TYPE


def test_earlier_runs_are_part_of_the_ring(tmp_path):
    for run in range(3):
        with Ring(tmp_path) as ring:
            ring.write(decision(run))
    assert numbers(tmp_path) == [0, 1, 2]


def test_other_files_are_left_alone(tmp_path, clock):
    (tmp_path / "drive.mcap").write_bytes(b"precious")
    with Ring(tmp_path, RingConfig(keep_s=1.0)) as ring:
        for second in range(100):
            clock.now_s += 1.0
            ring.write(decision(second))
    assert (tmp_path / "drive.mcap").read_bytes() == b"precious"


def test_full_disk_costs_the_oldest_file(tmp_path, clock, monkeypatch):
    with Ring(tmp_path) as ring:
        for second in range(50):
            clock.now_s += 1.0
            ring.write(decision(second))
        oldest = blackbox.segments(tmp_path)[0]
        write = blackbox.Recorder.write

        def full(self, message):
            if oldest.exists():
                raise RecordingError("no space left on device")
            write(self, message)

        monkeypatch.setattr(blackbox.Recorder, "write", full)
        ring.write(decision(50))
    assert not oldest.exists()
    assert numbers(tmp_path)[-1] == 50


def test_folder_belongs_to_one_black_box_at_a_time(tmp_path):
    with Ring(tmp_path), pytest.raises(RecordingError, match="in use by another"):
        Ring(tmp_path)
    Ring(tmp_path).close()


def test_folder_without_recordings_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="no recording"):
        list(blackbox.read(tmp_path))


def test_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="cannot use"):
        Ring(tmp_path / "file")


def test_size_out_of_range_is_refused_before_anything_is_removed(tmp_path, capsys):
    assert cli.record_main(["--black-box", str(tmp_path), "--minutes", "0"]) == 2
    assert "--black-box" not in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


KILLED = """
import sys, time, pathlib
from cbe_runtime.blackbox import Ring
from cbe_runtime.mcapfile import Recorded
ring = Ring(pathlib.Path(sys.argv[1]))
number = 0
while True:
    data = b'{"n":%d,"x":"%s"}' % (number, bytes(300).hex().encode())
    ring.write(Recorded("/cbe/decision", "cbe/Decision", data, number))
    ring.flush()
    number += 1
    if number % 100 == 0:
        print(number, flush=True)
"""


@pytest.mark.parametrize("hundreds", [3, 9])
def test_kill_costs_no_more_than_the_unfinished_chunk(tmp_path, hundreds):
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE, env=os.environ
    )
    for _ in range(hundreds):
        line = process.stdout.readline()
    assert line, "the writer died by itself"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    found = numbers(tmp_path)
    assert found == list(range(len(found)))
    assert len(found) >= int(line) - blackbox.CHUNK_BYTES // 600 - 1
