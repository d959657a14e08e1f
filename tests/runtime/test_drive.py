import logging
from dataclasses import replace

import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA, CameraModel
from cbe.errors import CameraError, RecordingError
from cbe.images import compress, raw
from cbe.messages import CameraInfo, CompressedImage
from cbe_runtime.drive import MotionFilter, RecordedDrive, StepSampler
from cbe_runtime.mcapfile import Recorded, Recorder
from cbe_runtime.view import View

WIDE = MODEL_CAMERA.scaled(160, 120)


def picture(step, size=(120, 160)):
    return np.random.default_rng(step).integers(0, 256, (*size, 3), np.uint8)


def record(path, images, hz=10, topic="/camera/image_raw", extra=()):
    with Recorder(path) as recorder:
        for message in extra:
            recorder.write(Recorded(*message))
        for step, image in enumerate(images):
            stamp = 5_000_000_000 + round(step * 1e9 / hz)
            message = image if isinstance(image, CompressedImage) else raw(image, stamp)
            recorder.write(Recorded(topic, message.TYPE, message.to_cdr(), stamp))
    return path


def info(camera, topic="/camera/camera_info"):
    return topic, CameraInfo.TYPE, CameraInfo.of(camera, 1).to_cdr(), 1


def taken(stamps_s):
    sampler = StepSampler()
    return [stamp for stamp in stamps_s if sampler.takes(round(stamp * 1e9))]


def test_frames_at_the_step_rate_are_all_taken():
    stamps = [round(7.0 + 0.1 * step + 0.02 * (-1) ** step, 3) for step in range(50)]
    assert taken(stamps) == stamps


@pytest.mark.parametrize("hz", [15, 20, 30, 60])
def test_faster_camera_is_thinned_to_ten_frames_a_second(hz):
    times = taken(np.arange(10 * hz) / hz)
    assert len(times) == pytest.approx(100, abs=1)
    assert np.diff(times).min() > 0.05


def test_gap_is_passed_over_without_a_burst():
    assert taken([0, 0.1, 0.2, 1.0, 1.03, 1.1]) == [0, 0.1, 0.2, 1.0, 1.1]


def test_repeated_stamp_is_taken_once():
    assert taken([0, 0, 0, 0.1, 0.1]) == [0, 0.1]


def test_clock_that_starts_anew_is_followed():
    assert taken([50.0, 50.1, 3.0, 3.1]) == [50.0, 50.1, 3.0, 3.1]


def test_frame_without_motion_is_passed_over():
    motion = MotionFilter()
    still = picture(0, (64, 64)) // 2
    nudged = still.copy()
    nudged[0] += 1
    assert [motion.moved(image) for image in (still, still, nudged, still + 1)] == [
        True, False, False, True,
    ]  # fmt: skip


def test_recording_yields_one_view_a_step(tmp_path):
    path = record(tmp_path / "d.mcap", [picture(step) for step in range(30)], hz=30)
    drive = RecordedDrive.open(path)
    assert drive.camera == WIDE
    frames = list(drive.frames())
    assert len(frames) == 11
    assert frames[0].shape == (64, 64, 3)
    np.testing.assert_array_equal(frames[1], View(WIDE)(raw(picture(2), 1)))


def test_recording_is_read_the_same_at_every_pass(tmp_path):
    drive = RecordedDrive.open(record(tmp_path / "d.mcap", map(picture, range(5))))
    np.testing.assert_array_equal(list(drive.frames()), list(drive.frames()))


def test_calibration_beside_the_camera_is_used(tmp_path):
    camera = CameraModel(160, 120, 70.0, 70.0, 80.0, 60.0)
    path = record(
        tmp_path / "d.mcap",
        map(picture, range(3)),
        extra=[info(camera), info(WIDE, "/rear/camera_info")],
    )
    assert RecordedDrive.open(path).camera == camera
    assert RecordedDrive.open(path, camera=WIDE).camera == WIDE


def test_camera_too_narrow_is_refused_with_the_figures(tmp_path):
    camera = CameraModel(160, 120, 400.0, 400.0, 80.0, 60.0)
    path = record(tmp_path / "d.mcap", map(picture, range(3)), extra=[info(camera)])
    with pytest.raises(CameraError, match="deg"):
        RecordedDrive.open(path)


def test_view_is_assumed_with_a_warning_and_only_for_its_shape(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        RecordedDrive.open(record(tmp_path / "a.mcap", [picture(0)]))
    assert "--camera" in caplog.text
    with pytest.raises(CameraError, match="--camera"):
        RecordedDrive.open(record(tmp_path / "b.mcap", [picture(0, (90, 160))]))


def test_camera_is_chosen_by_name_among_several(tmp_path):
    rear = ("/rear/image", CompressedImage.TYPE, compress(picture(9), 1).to_cdr(), 1)
    path = record(tmp_path / "d.mcap", map(picture, range(3)), extra=[rear])
    with pytest.raises(RecordingError, match=r"--topic.*/rear/image.*/camera/image_raw"):
        RecordedDrive.open(path)
    assert RecordedDrive.open(path, "rear/image").topic == "/rear/image"
    with pytest.raises(RecordingError, match="no camera topic front"):
        RecordedDrive.open(path, "front")


def test_recording_without_a_camera_is_refused(tmp_path):
    path = record(tmp_path / "d.mcap", [], extra=[info(WIDE)])
    with pytest.raises(RecordingError, match="no camera topic"):
        RecordedDrive.open(path)


def test_damaged_frame_is_left_out(tmp_path, caplog):
    good = [compress(picture(step), step * 100_000_000 + 1) for step in range(4)]
    bad = replace(good[2], data=good[2].data[:50])
    path = record(tmp_path / "d.mcap", [*good[:2], bad, good[3]])
    drive = RecordedDrive.open(path)
    assert len(list(drive.frames())) == 3
    assert "left out 1 frames" in caplog.text
