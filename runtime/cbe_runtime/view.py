"""The model's view of whatever camera there is."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

from cbe.camera import MODEL_CAMERA, CameraModel, Preprocessor
from cbe.errors import CameraError
from cbe.images import decode_image

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cbe.messages import CameraInfo, CompressedImage, Image

logger = logging.getLogger(__name__)

_ASSUMED_ASPECTS = (1.0, 4.0 / 3.0)
"""Width over height of images that, without a calibration, are taken to show the model's view."""


class View:
    """Turns image messages into the model's (64, 64, 3) view.

    The camera is the one given, else the one that CameraInfo describes, else the model's own
    view where the image has its shape.
    """

    def __init__(self, camera: CameraModel | None = None) -> None:
        self._given = camera
        self._info: CameraInfo | None = None
        self._refusal: str | None = None
        self._preprocessor = None if camera is None else _preprocessor(camera)

    @property
    def camera(self) -> CameraModel | None:
        """The camera in use, None before the first calibration or image."""
        return self._preprocessor.camera if self._preprocessor else None

    def calibrate(self, info: CameraInfo) -> None:
        """Take a CameraInfo into account; a camera given at the start wins.

        Raises:
            CameraError: the calibration is unusable or covers too little of the model's view.
        """
        known = self._info
        if self._given is not None or (
            known is not None
            and (known.width, known.height, known.matrix, known.distortion)
            == (info.width, info.height, info.matrix, info.distortion)
        ):
            return
        self._info = info
        self._preprocessor = self._refusal = None
        try:
            camera = info.camera()
            if not any(camera.distortion):
                camera = replace(camera, distortion=())  # a route pays for every number
            self._preprocessor = _preprocessor(camera)
        except CameraError as refusal:
            # A camera known to be unusable must not fall back to the assumed view.
            self._refusal = str(refusal)
            raise

    def __call__(self, message: CompressedImage | Image) -> NDArray[np.uint8]:
        """The model's view (64, 64, 3) uint8 RGB of an image message.

        Raises:
            MessageError: the image does not decode.
            CameraError: it does not fit the calibration, or there is none.
        """
        if self._refusal is not None:
            raise CameraError(self._refusal)
        image = decode_image(message)
        if self._preprocessor is None:
            self._preprocessor = _assumed(width=image.shape[1], height=image.shape[0])
        return self._preprocessor(image)


def _preprocessor(camera: CameraModel) -> Preprocessor:
    preprocessor = Preprocessor(camera)
    logger.info("the camera covers %s of the model's view", preprocessor.coverage)
    return preprocessor


def _assumed(width: int, height: int) -> Preprocessor:
    if not any(abs(width / height - aspect) < 0.01 for aspect in _ASSUMED_ASPECTS):
        raise CameraError(
            f"a {width} x {height} image came without calibration; publish camera_info or give "
            "the camera's intrinsics with --camera"
        )
    logger.warning(
        "no camera_info: taking the %d x %d image to show 120 x 107 deg; if it does not, give "
        "the camera's intrinsics with --camera",
        width,
        height,
    )
    return Preprocessor(MODEL_CAMERA.scaled(width, height))
