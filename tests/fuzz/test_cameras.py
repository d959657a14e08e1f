"""Calibrations: numbers that a CameraInfo, a route or a configuration may hold."""

import random
from dataclasses import replace

import numpy as np

from cbe.camera import CameraModel
from cbe.messages import CameraInfo, Image
from cbe_runtime.view import View

from .harness import SEED
from .mutate import mutants

CAMERAS = [
    CameraModel(64, 48, 20.0, 19.0, 32.0, 24.0),
    CameraModel(64, 48, 20.0, 19.0, 32.0, 24.0, "pinhole", (0.1, -0.05, 0.0, 0.0)),
    CameraModel(64, 48, 20.0, 19.0, 32.0, 24.0, "pinhole", (0.1, 0, 0, 0, 0, 0.1, 0, 0)),
    CameraModel(64, 48, 20.0, 19.0, 32.0, 24.0, "fisheye", (0.1, 0.0, 0.0, 0.0)),
]
STRANGE = [0.0, -1.0, 1e-320, 1e-300, 1e-30, 1e-6, 0.5, 1e3, 1e6, 1e30, 1e300, -1e300, -1e30]


def hostile():
    """Bits flipped in the message's bytes, and whole numbers replaced."""
    rng = random.Random(SEED)
    infos = [CameraInfo.of(camera, 1) for camera in CAMERAS]
    flipped = mutants([info.to_cdr() for info in infos], SEED)
    while True:
        yield next(flipped)
        info = rng.choice(infos)
        matrix, distortion = list(info.matrix), list(info.distortion)
        for _ in range(rng.choice((1, 1, 2, 4))):
            numbers = rng.choice((matrix, distortion))
            numbers[rng.randrange(len(numbers))] = rng.choice(STRANGE) * rng.uniform(0.5, 2.0)
        size = rng.choice(((48, 64), (48, 64), (1, 1), (16_384, 16_384), (1, 16_384), (2, 3)))
        changed = {"matrix": tuple(matrix), "distortion": tuple(distortion)}
        yield replace(info, height=size[0], width=size[1], **changed).to_cdr()


def test_hostile_calibration_is_refused_soon_and_small(fuzzed):
    def read(data):
        view = View()
        info = CameraInfo.from_cdr(data)
        view.calibrate(info)
        if info.width * info.height > 2**20:
            return
        pixels = np.zeros(info.width * info.height, np.uint8)
        image = Image(1, "", info.height, info.width, "mono8", info.width, pixels)
        assert view(image).shape == (64, 64, 3)

    valid = [CameraInfo.of(camera, 1).to_cdr() for camera in CAMERAS]
    report = fuzzed("cameras", read, valid, hostile(), share=0.2)
    assert 0 < report.accepted < report.inputs
