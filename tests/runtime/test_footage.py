"""A recording's frames and odometry, as training takes them."""

import math

import numpy as np
import pytest

from cbe.errors import RecordingError
from cbe.images import raw
from cbe.messages import Odometry
from cbe_runtime import cli, footage
from cbe_runtime.drive import RecordedDrive
from cbe_runtime.mcapfile import Recorded, Recorder
from cbe_training.footage import Footage

SPEED_MPS, YAW_RATE = 0.4, 0.2


def stamp_of(second):
    return 5_000_000_000 + round(second * 1e9)


def record(path, seconds, odometry):
    """Frames at 10 Hz and odometry (second, pose) as given."""
    random = np.random.default_rng(0)
    with Recorder(path) as recorder:
        for second, pose in odometry:
            message = Odometry.planar(stamp_of(second), pose, SPEED_MPS, YAW_RATE)
            recorder.write(Recorded("/odom", message.TYPE, message.to_cdr(), stamp_of(second)))
        for second in seconds:
            image = raw(random.integers(0, 256, (120, 160, 3), np.uint8), stamp_of(second))
            recorder.write(
                Recorded("/camera/image_raw", image.TYPE, image.to_cdr(), stamp_of(second))
            )
    return path


def circle(second):
    yaw = YAW_RATE * second + 3.0  # passes the half turn
    radius = SPEED_MPS / YAW_RATE
    return radius * math.sin(yaw), -radius * math.cos(yaw), math.remainder(yaw, math.tau)


TIMES = np.arange(0.0, 5.0, 0.1)
ODOMETRY = [(second, circle(second)) for second in np.arange(-0.02, 5.1, 0.05)]


@pytest.fixture
def drive(tmp_path):
    return record(tmp_path / "drive.mcap", TIMES, ODOMETRY)


def test_each_frame_has_the_pose_of_its_stamp(drive):
    views, poses = footage.extract(RecordedDrive.open(drive))
    assert views.shape == (len(TIMES), 64, 64, 3)
    expected = np.array([circle(second) for second in TIMES])
    np.testing.assert_allclose(poses[:, :2], expected[:, :2], atol=1e-3)
    np.testing.assert_allclose(poses[:, 2], YAW_RATE * TIMES + 3.0, atol=1e-3)  # no jump


def test_frames_before_and_after_the_odometry_are_left_out(tmp_path):
    path = record(tmp_path / "d.mcap", TIMES, [each for each in ODOMETRY if 1.0 <= each[0] <= 4.2])
    views, poses = footage.extract(RecordedDrive.open(path))
    assert len(views) == len(poses) == 31  # from 1.1 to 4.1 s: the odometry is from 1.03 to 4.18


def test_recording_without_odometry_is_refused(tmp_path):
    path = record(tmp_path / "d.mcap", TIMES, [])
    with pytest.raises(RecordingError, match="no odometry"):
        footage.extract(RecordedDrive.open(path))


def test_odometry_of_another_time_is_refused(tmp_path):
    late = [(second + 100.0, pose) for second, pose in ODOMETRY]
    with pytest.raises(RecordingError, match="0 of 50 frames"):
        footage.extract(RecordedDrive.open(record(tmp_path / "d.mcap", TIMES, late)))


@pytest.mark.parametrize("where", [3.0, math.nan])
def test_odometry_that_jumps_or_is_no_number_is_refused(tmp_path, where):
    jumping = [(s, (where, 0.0, 0.0) if 2.0 < s < 2.1 else pose) for s, pose in ODOMETRY]
    with pytest.raises(RecordingError, match="m/s"):
        footage.extract(RecordedDrive.open(record(tmp_path / "d.mcap", TIMES, jumping)))


def test_command_writes_what_training_reads(drive, tmp_path, capsys):
    out = tmp_path / "drive.npz"
    assert cli.route_main(["frames", str(drive), "-o", str(out)]) == 0
    assert "50 frames, 2.0 m" in capsys.readouterr().out
    assert Footage.load(out).views.shape == (50, 64, 64, 3)


def test_file_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="cannot write"):
        footage.save(tmp_path / "none" / "drive.npz", np.zeros((1, 64, 64, 3)), np.zeros((1, 3)))
