"""Camera models and the networks' view."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cbe.camera import MODEL_CAMERA, CameraModel, Preprocessor, coverage
from cbe.errors import CameraError

FISHEYE = CameraModel(640, 480, 190.0, 190.0, 320.0, 240.0, "fisheye", (0.02, -0.004, 0.0, 0.0))
WIDE = CameraModel(640, 480, 150.0, 150.0, 320.0, 240.0)


def narrow(horizontal_deg: float, vertical_deg: float) -> CameraModel:
    fx = 320.0 / np.tan(np.radians(0.5 * horizontal_deg))
    fy = 240.0 / np.tan(np.radians(0.5 * vertical_deg))
    return CameraModel(640, 480, float(fx), float(fy), 320.0, 240.0)


def directions(camera: CameraModel) -> np.ndarray:
    """Image whose red and green say where each pixel looks: 128 + 60 x, 128 + 60 y."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    if camera.model == "fisheye":
        grid = np.linspace(0.0, 1.5, 4000)
        angle = np.hypot(x, y)
        bent = grid * (1.0 + sum(k * grid ** (2 * n) for n, k in enumerate(camera.distortion, 1)))
        theta = np.interp(angle, bent, grid)
        scale = np.tan(theta) / np.maximum(angle, 1e-9)
        x, y = x * scale, y * scale
    image = np.stack([128.0 + 60.0 * x, 128.0 + 60.0 * y, np.full_like(x, 200.0)], axis=-1)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_model_camera_sees_120_by_107_degrees() -> None:
    seen = coverage(MODEL_CAMERA)
    assert seen.horizontal_deg == pytest.approx(120.0, abs=0.1)
    assert seen.vertical_deg == pytest.approx(107.0, abs=0.1)
    assert seen.share == 1.0


def test_image_of_the_model_camera_passes_unchanged() -> None:
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    assert np.array_equal(Preprocessor(MODEL_CAMERA)(image), image)


def test_larger_image_of_the_same_view_becomes_the_mean_over_each_pixel() -> None:
    image = np.random.default_rng(0).integers(0, 256, (128, 192, 3), np.uint8)
    blocks = image.reshape(64, 2, 64, 3, 3).mean(axis=(1, 3))
    out = Preprocessor(MODEL_CAMERA.scaled(192, 128))(image)
    assert np.abs(out.astype(float) - blocks).max() <= 0.5 + 1e-6


@pytest.mark.parametrize(
    "camera",
    [
        MODEL_CAMERA.scaled(160, 120),
        WIDE,
        WIDE.scaled(1280, 960),
        FISHEYE,
        FISHEYE.scaled(320, 240),
    ],
    ids=["same view", "wide", "wide and large", "fisheye", "small fisheye"],
)
def test_every_camera_looks_where_the_model_camera_looks(camera: CameraModel) -> None:
    out = Preprocessor(camera)(directions(camera)).astype(float)
    seen = out[..., 2] == 200.0
    assert seen.mean() > 0.85
    error = np.abs(out - directions(MODEL_CAMERA))[seen]
    assert error.max() < 2.5  # a pixel of the view is 3.2 wide and 2.5 high in these colours


def test_narrow_camera_leaves_black_borders_of_the_right_size() -> None:
    preprocessor = Preprocessor(narrow(70.0, 55.0))
    out = preprocessor(np.full((480, 640, 3), 255, np.uint8))
    half = np.array([18.48 * np.tan(np.radians(35.0)), 23.68 * np.tan(np.radians(27.5))])
    white_px = out[..., 0].astype(float).sum() / 255.0
    assert white_px == pytest.approx(4.0 * half.prod(), rel=0.02)
    assert not out[:19].any()
    assert not out[:, :18].any()
    assert preprocessor.coverage.horizontal_deg == pytest.approx(70.0, abs=0.7)
    assert str(preprocessor.coverage) == "70 x 55 deg"


@pytest.mark.parametrize("size", [(55.0, 90.0), (100.0, 40.0)])
def test_camera_that_covers_under_half_the_view_is_refused_with_the_figures(
    size: tuple[float, float],
) -> None:
    with pytest.raises(CameraError, match=f"{size[0]:.0f} x {size[1]:.0f} deg.*120 x 107 deg"):
        Preprocessor(narrow(*size))


def test_fine_pattern_does_not_alias() -> None:
    columns = np.arange(2560) % 2 * 255
    image = np.repeat(np.repeat(columns[None, :, None], 1920, 0), 3, 2).astype(np.uint8)
    camera = replace(WIDE.scaled(2560, 1920), fx=700.0)  # not the same view: remapped
    middle = Preprocessor(camera)(image)[24:40, 24:40]
    assert np.ptp(middle.astype(int)) <= 6
    assert middle.mean() == pytest.approx(127.5, abs=3.0)


def test_ray_beyond_the_fold_of_the_distortion_is_not_seen() -> None:
    barrel = CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, "pinhole", (-0.3, 0.0, 0.0, 0.0))
    x = np.array([0.0, 0.9, 1.3, 1.7])  # r (1 - 0.3 r2) turns back at r = 1.05
    u, _, seen = barrel.project(x, np.zeros(4))
    assert (u[2:] < 640.0).all()
    assert seen.tolist() == [True, True, False, False]


def test_distortion_agrees_with_opencv() -> None:
    import cv2

    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.8, 0.8, (50, 2)), np.ones(50)])
    zero = np.zeros(3)
    k8 = (-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001)
    for camera in (replace(WIDE, distortion=k8), replace(WIDE, distortion=k8[:5]), FISHEYE):
        u, v, _ = camera.project(rays[:, 0], rays[:, 1])
        matrix, k = np.array(camera.matrix).reshape(3, 3), np.array(camera.distortion)
        if camera.model == "fisheye":
            expected, _ = cv2.fisheye.projectPoints(rays[:, None], zero, zero, matrix, k)
        else:
            expected, _ = cv2.projectPoints(rays, zero, zero, matrix, k)
        ours = np.column_stack([u, v]) - 0.5  # OpenCV's pixel centres are whole numbers
        np.testing.assert_allclose(ours, expected.reshape(-1, 2), atol=1e-6)


@given(
    st.integers(1, 4000),
    st.integers(1, 4000),
    st.floats(1.0, 5000.0),
    st.floats(-100.0, 4000.0),
    st.sampled_from([("pinhole", 0), ("pinhole", 5), ("pinhole", 8), ("fisheye", 4)]),
)
def test_json_round_trip_gives_the_same_camera(
    width: int, height: int, focal: float, centre: float, model: tuple[str, int]
) -> None:
    distortion = (0.01,) * model[1]
    camera = CameraModel(width, height, focal, focal, centre, centre, model[0], distortion)
    assert CameraModel.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera


def test_calibration_round_trip_gives_the_same_camera() -> None:
    name = "equidistant"
    again = CameraModel.from_calibration(640, 480, FISHEYE.matrix, name, FISHEYE.distortion)
    assert again == FISHEYE


GOOD = MODEL_CAMERA.to_dict()


@pytest.mark.parametrize(
    "bad",
    [
        {},
        {**GOOD, "extra": 1},
        {**GOOD, "width": 64.5},
        {**GOOD, "width": True},
        {**GOOD, "width": 0},
        {**GOOD, "height": 10**9},
        {**GOOD, "fx": "18"},
        {**GOOD, "fx": 0.0},
        {**GOOD, "fy": float("nan")},
        {**GOOD, "model": "omni"},
        {**GOOD, "model": None},
        {**GOOD, "distortion": 1.0},
        {**GOOD, "distortion": [0.1, 0.2]},
        {**GOOD, "distortion": ["a"] * 4},
    ],
)
def test_malformed_camera_is_refused(bad: dict[str, object]) -> None:
    with pytest.raises(CameraError):
        CameraModel.from_dict(bad)


def test_uncalibrated_camera_info_is_refused() -> None:
    with pytest.raises(CameraError, match="uncalibrated"):
        CameraModel.from_calibration(640, 480, (0.0,) * 9)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640, 3), np.uint8),
        np.zeros((64, 64), np.uint8),
        np.zeros((64, 64, 3), np.float32),
    ],
)
def test_image_that_does_not_fit_the_camera_is_refused(image: np.ndarray) -> None:
    with pytest.raises(CameraError, match=r"\(64, 64, 3\)"):
        Preprocessor(MODEL_CAMERA)(image)


def test_import_pulls_numpy_alone() -> None:
    code = (
        "import sys, cbe.camera; print({'cv2', 'zenoh', 'rosbags', 'msgspec'} & set(sys.modules))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "set()"
