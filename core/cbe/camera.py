"""Camera models, and any camera's images turned into the view that the networks were trained on."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.errors import CameraError

Pixels = NDArray[np.uint8]
Floats = NDArray[np.float64]

MAX_SIDE_PX = 16_384
MAX_NUMBER = 1e6
"""Far beyond any lens; its powers are still finite."""
MIN_VIEW_SHARE = 0.5
MAX_SUPERSAMPLE = 4
COEFFICIENTS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
"""Numbers of distortion coefficients that each model takes, in OpenCV's order."""
ROS_MODELS = {
    "": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""CameraInfo's distortion_model to ours."""


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics of a camera that looks level and forward.

    Pixel (row, column) has its centre at (column + 0.5, row + 0.5), so an undistorted ray
    (x right, y down, 1 forward) meets the image at (fx x + cx, fy y + cy), in pixels.
    `model` is "pinhole" (distortion k1 k2 p1 p2 [k3 [k4 k5 k6]], as OpenCV's) or "fisheye"
    (equidistant; distortion k1 k2 k3 k4).

    Raises CameraError for numbers that no camera has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "pinhole"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Refuse sizes, focal lengths, models and coefficients out of range."""
        if not (0 < self.width <= MAX_SIDE_PX and 0 < self.height <= MAX_SIDE_PX):
            raise CameraError(
                f"camera size {self.width} x {self.height} px is outside 1 to {MAX_SIDE_PX}"
            )
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(abs(number) <= MAX_NUMBER for number in numbers):  # nor NaN
            raise CameraError(
                f"camera intrinsics must lie within +-{MAX_NUMBER:g}; found {numbers[:12]}"
            )
        if min(self.fx, self.fy) <= 0.0:
            raise CameraError(
                f"focal lengths must be positive pixels; found fx {self.fx}, fy {self.fy}; "
                "an uncalibrated camera publishes zeros: calibrate it"
            )
        if self.model not in COEFFICIENTS:
            raise CameraError(
                f"unknown camera model {self.model[:32]!r}; known: {list(COEFFICIENTS)}"
            )
        if len(self.distortion) not in COEFFICIENTS[self.model]:
            raise CameraError(
                f"{self.model} takes {COEFFICIENTS[self.model]} distortion coefficients; "
                f"found {len(self.distortion)}"
            )

    @classmethod
    def from_calibration(
        cls,
        width: int,
        height: int,
        matrix: tuple[float, ...],
        distortion_model: str = "plumb_bob",
        distortion: tuple[float, ...] = (),
    ) -> "CameraModel":
        """Build it from the numbers of a ROS CameraInfo: `matrix` is K (9), row by row.

        ROS and OpenCV put pixel centres at whole numbers, so the centre moves by half a pixel.
        """
        if distortion_model not in ROS_MODELS:
            raise CameraError(
                f"unknown distortion model {distortion_model[:32]!r}; known: {list(ROS_MODELS)}"
            )
        if len(matrix) != 9:
            raise CameraError(f"a camera matrix has 9 numbers; found {len(matrix)}")
        fx, _, cx, _, fy, cy = matrix[:6]
        model = ROS_MODELS[distortion_model]
        return cls(width, height, fx, fy, cx + 0.5, cy + 0.5, model, distortion)

    @property
    def matrix(self) -> tuple[float, ...]:
        """K (9) of a ROS CameraInfo, row by row."""
        return (self.fx, 0.0, self.cx - 0.5, 0.0, self.fy, self.cy - 0.5, 0.0, 0.0, 1.0)

    def scaled(self, width: int, height: int) -> "CameraModel":
        """The same view in another size."""
        x, y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * x,
            fy=self.fy * y,
            cx=self.cx * x,
            cy=self.cy * y,
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self) | {"distortion": list(self.distortion)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "CameraModel":
        """Inverse of `to_dict`; raises CameraError on missing, unknown or mistyped entries."""
        names = {field.name for field in fields(cls)}
        required = names - {"model", "distortion"}
        if not required <= values.keys() <= names:
            raise CameraError(
                f"a camera has entries {sorted(names)}; found {str(sorted(values))[:200]}"
            )
        values = {"model": "pinhole", "distortion": (), **values}
        sizes = (values["width"], values["height"])
        numbers = [values[name] for name in ("fx", "fy", "cx", "cy")]
        if not isinstance(values["distortion"], (list, tuple)):
            raise CameraError("distortion must be a list of numbers")
        numbers += values["distortion"]
        if (
            not all(type(size) is int for size in sizes)
            or not all(type(number) in (int, float) for number in numbers)
            or not isinstance(values["model"], str)
        ):
            raise CameraError(
                "a camera's width and height are whole numbers, its model is a name, the others "
                f"are numbers; found {str(dict(values))[:200]}"
            )
        if not all(abs(number) <= MAX_NUMBER for number in (*sizes, *numbers)):
            raise CameraError(f"a camera's numbers must lie within +-{MAX_NUMBER:g}")
        fx, fy, cx, cy, *distortion = (float(number) for number in numbers)
        return cls(*sizes, fx, fy, cx, cy, values["model"], tuple(distortion))

    def project(self, x: Floats, y: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Pixel coordinates of rays (x right, y down, 1 forward), and whether they are seen.

        All arrays share one shape. A ray is seen where it meets the image before the distortion
        polynomial, fitted inside the image only, folds back onto it.
        """
        r = np.hypot(x, y)
        factor = self._stretch(r)
        dx, dy = x * factor, y * factor
        if self.model == "pinhole" and self.distortion:
            p1, p2 = self.distortion[2:4]
            dx += 2.0 * p1 * x * y + p2 * (r**2 + 2.0 * x**2)
            dy += p1 * (r**2 + 2.0 * y**2) + 2.0 * p2 * x * y
        u, v = self.fx * dx + self.cx, self.fy * dy + self.cy
        seen = (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
        return u, v, seen & (r <= self._fold(float(r.max(initial=0.0))))

    def _stretch(self, r: Floats) -> Floats:
        """Distorted radius over undistorted radius."""
        if self.model == "fisheye":
            theta = np.arctan(r)
            powers = np.stack([theta ** (2 * n) for n in range(1, 5)], axis=-1)  # r.shape + (4,)
            bent = theta * (1.0 + powers @ np.array(self.distortion or (0.0,) * 4))
            return np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
        k = (*self.distortion, *(0.0,) * 8)
        r2 = r**2
        above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
        below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
        return above / np.where(np.abs(below) > 1e-9, below, 1e-9)

    def _fold(self, r_max: float) -> float:
        """Radius up to which the distortion grows outwards, as a lens does."""
        r = np.linspace(0.0, r_max, 2049)
        shrinks = np.diff(r * self._stretch(r)) <= 0.0
        return float(r[int(shrinks.argmax())]) if shrinks.any() else math.inf


MODEL_CAMERA = CameraModel(64, 64, 18.48, 23.68, 32.0, 32.0)
"""The networks' view: 120 x 107 deg."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """How much of the networks' view a camera sees: degrees along its middle row and column.

    `share` is that of the view's solid angle.
    """

    horizontal_deg: float
    vertical_deg: float
    share: float

    def __str__(self) -> str:
        return f"{self.horizontal_deg:.0f} x {self.vertical_deg:.0f} deg"


class Preprocessor:
    """Turns a camera's images into the networks' view; what the camera does not see stays black.

    `coverage` tells how much it sees. Raises CameraError where that is under half the view's
    width or height in degrees.
    """

    def __init__(self, camera: CameraModel, view: CameraModel = MODEL_CAMERA) -> None:
        self.camera = camera
        self.view = view
        self.coverage = coverage(camera, view)
        whole = coverage(view, view)
        if (
            self.coverage.horizontal_deg < MIN_VIEW_SHARE * whole.horizontal_deg
            or self.coverage.vertical_deg < MIN_VIEW_SHARE * whole.vertical_deg
        ):
            raise CameraError(
                f"the camera covers {self.coverage} of the networks' {whole}; at least half "
                "of each is needed: use a wider lens, or check the camera's calibration"
            )
        self._remap = None if _same_view(camera, view) else _Remap(camera, view)

    def __call__(self, image: Pixels) -> Pixels:
        """The networks' view (64, 64, 3) uint8 RGB of an image (height, width, 3) uint8 RGB."""
        expected = (self.camera.height, self.camera.width, 3)
        if image.shape != expected or image.dtype != np.uint8:
            raise CameraError(
                f"an image of the camera is {expected} uint8; found {image.shape} {image.dtype}; "
                "check that the calibration belongs to this image size"
            )
        if self._remap is not None:
            return self._remap(image)
        return _resize(image, self.view.width, self.view.height)


class _Remap:
    """Samples the camera at subpixels of the view and averages them, so nothing aliases."""

    def __init__(self, camera: CameraModel, view: CameraModel) -> None:
        import cv2

        pitch_px = _pixel_pitch(camera, view)
        # What supersampling cannot bridge is averaged away in the camera's image first.
        shrink = max(1.0, pitch_px / MAX_SUPERSAMPLE)
        self._size = (round(camera.width / shrink), round(camera.height / shrink))
        source = camera.scaled(*self._size)
        factor = min(MAX_SUPERSAMPLE, max(1, math.ceil(pitch_px / shrink)))
        u, v, seen = source.project(*_rays(view, factor))
        # OpenCV's pixel centres are whole numbers. At the rim the outermost pixels go on to
        # their edge, and beyond it is black.
        u = np.where(seen, np.clip(u - 0.5, 0.0, source.width - 1.0), -9.0)
        v = np.where(seen, np.clip(v - 0.5, 0.0, source.height - 1.0), -9.0)
        # Fixed point halves the time; a 32nd of a pixel is fine enough.
        self._maps = cv2.convertMaps(
            u.astype(np.float32), v.astype(np.float32), cv2.CV_16SC2, nninterpolation=False
        )
        self._view = view

    def __call__(self, image: Pixels) -> Pixels:
        import cv2

        small = _resize(image, *self._size)
        fine = cv2.remap(small, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return _resize(np.asarray(fine, np.uint8), self._view.width, self._view.height)


def coverage(camera: CameraModel, view: CameraModel = MODEL_CAMERA) -> Coverage:
    """How much of a pinhole `view` the camera sees."""
    x, y = _rays(view, 2)  # (2 h, 2 w) each
    _, _, seen = camera.project(x, y)
    weight = (1.0 + x**2 + y**2) ** -1.5  # solid angle of equal cells of the image plane
    across_rad = _angles(view.cx, view.fx, view.width)
    down_rad = _angles(view.cy, view.fy, view.height)
    level = np.zeros_like(across_rad)
    _, _, seen_across = camera.project(np.tan(across_rad), level)
    _, _, seen_down = camera.project(level, np.tan(down_rad))
    return Coverage(
        horizontal_deg=float(np.degrees(np.ptp(across_rad)) * seen_across.mean()),
        vertical_deg=float(np.degrees(np.ptp(down_rad)) * seen_down.mean()),
        share=float(weight[seen].sum() / weight.sum()),
    )


def _angles(centre_px: float, focal_px: float, size_px: int) -> Floats:
    """Angles (2000,) rad evenly across a pinhole image's axis."""
    first, last = np.arctan([-centre_px / focal_px, (size_px - centre_px) / focal_px])
    return np.linspace(first + 1e-9, last - 1e-9, 2000)  # inside, whatever is rounded


def _rays(view: CameraModel, factor: int) -> tuple[Floats, Floats]:
    """Directions x, y (factor * height, factor * width) of a view's subpixels."""
    column = (np.arange(view.width * factor) + 0.5) / factor
    row = (np.arange(view.height * factor) + 0.5) / factor
    x, y = np.meshgrid((column - view.cx) / view.fx, (row - view.cy) / view.fy)
    return x, y


def _pixel_pitch(camera: CameraModel, view: CameraModel) -> float:
    """Camera pixels from one pixel of the view to the next, where the camera sees both.

    Raises CameraError where it sees no two neighbours.
    """
    u, v, seen = camera.project(*_rays(view, 1))
    steps = [
        np.hypot(np.diff(u, axis=axis), np.diff(v, axis=axis))[
            np.take(seen, range(1, seen.shape[axis]), axis)
            & np.take(seen, range(seen.shape[axis] - 1), axis)
        ]
        for axis in (0, 1)
    ]
    if not all(step.size for step in steps):
        raise CameraError("the camera's lens scatters what it sees; check its calibration")
    return max(float(np.median(step)) for step in steps)


def _same_view(camera: CameraModel, view: CameraModel) -> bool:
    """Whether the camera differs from the view in size alone, to a tenth of a view pixel."""
    if camera.model != view.model or any(camera.distortion):
        return False
    same = camera.scaled(view.width, view.height)
    edges = (
        (0.0 - same.cx) / same.fx * view.fx + view.cx,
        (view.width - same.cx) / same.fx * view.fx + view.cx - view.width,
        (0.0 - same.cy) / same.fy * view.fy + view.cy,
        (view.height - same.cy) / same.fy * view.fy + view.cy - view.height,
    )
    return max(map(abs, edges)) < 0.1


def _resize(image: Pixels, width: int, height: int) -> Pixels:
    """Mean over each new pixel's area; linear where the image grows."""
    if image.shape[:2] == (height, width):
        return image
    import cv2

    shrinks = image.shape[0] >= height and image.shape[1] >= width
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), np.uint8)
