"""The model's view of a camera that cannot be used."""

import gc
import weakref

import numpy as np
import pytest

from cbe.camera import CameraModel
from cbe.errors import CameraError
from cbe.messages import CameraInfo, Image
from cbe_runtime.view import View


def test_images_of_a_refused_camera_are_refused_and_let_go():
    view = View()
    narrow = CameraModel(64, 48, 3000.0, 3000.0, 32.0, 24.0)
    with pytest.raises(CameraError, match="covers"):
        view.calibrate(CameraInfo.of(narrow, 1))
    gone = []
    gc.disable()
    try:
        for _ in range(3):
            pixels = np.zeros(64 * 48, np.uint8)
            gone.append(weakref.ref(pixels))
            with pytest.raises(CameraError, match="covers"):
                view(Image(1, "", 48, 64, "mono8", 64, pixels))
            del pixels
        gc.collect()  # what pytest.raises holds on to
        assert [each() for each in gone] == [None] * 3
    finally:
        gc.enable()
