"""A recorded drive as training takes it: what the camera saw each step, and where that was."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import CameraError, MessageError, RecordingError
from cbe.messages import Odometry
from cbe.robot import STEP_S
from cbe_runtime import mcapfile
from cbe_runtime.drive import IMAGE_TYPES, StepSampler
from cbe_runtime.view import View

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe_runtime.drive import RecordedDrive

FASTEST_MPS = 5.0
"""Faster than this odometry does not drive but jump."""
LEAST_FRAMES = 30


def extract(drive: RecordedDrive) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Views (T, 64, 64, 3) of a drive, one a step, and their poses (T, 3) by its odometry.

    Poses (x and y in m, heading in rad) are interpolated at the frames' stamps; frames outside
    the odometry's time are left out.

    Raises:
        RecordingError: there is no odometry, it jumps, or few frames lie in its time.
    """
    view, sampler = View(drive.camera), StepSampler()
    views: list[NDArray[np.uint8]] = []
    seen_ns: list[int] = []
    known: dict[int, tuple[float, ...]] = {}
    for message in mcapfile.read(drive.path):
        try:
            if message.type_name == Odometry.TYPE:
                odometry = Odometry.from_cdr(message.data)
                known[odometry.stamp_ns] = tuple(odometry.pose)
            elif message.topic == drive.topic and message.type_name in IMAGE_TYPES:
                image = IMAGE_TYPES[message.type_name].from_cdr(message.data)
                if sampler.takes(image.stamp_ns):
                    views.append(view(image))
                    seen_ns.append(image.stamp_ns)
        except (MessageError, CameraError):  # a damaged one is left out, as in teaching
            continue
    if len(known) < 2:
        raise RecordingError(
            f"{drive.path} holds no odometry ({Odometry.TYPE}), but training must know where each "
            "frame was seen; record the topic odom too"
        )
    stamps_ns = np.array(sorted(known))
    poses = np.array([known[stamp] for stamp in stamps_ns.tolist()])
    poses[:, 2] = np.unwrap(poses[:, 2])
    at_ns = np.array(seen_ns, np.int64)
    inside = (at_ns >= stamps_ns[0]) & (at_ns <= stamps_ns[-1])
    if inside.sum() < LEAST_FRAMES:
        raise RecordingError(
            f"{drive.path}: {inside.sum()} of {len(at_ns)} frames lie within the time of its "
            f"odometry; expected {LEAST_FRAMES} or more: both need stamps of one clock"
        )
    since_s = 1e-9 * (stamps_ns - stamps_ns[0])
    at_s = 1e-9 * (at_ns[inside] - stamps_ns[0])
    found = np.stack([np.interp(at_s, since_s, column) for column in poses.T], axis=-1)
    fastest_mps = np.hypot(*np.diff(found[:, :2], axis=0).T).max() / STEP_S
    if not fastest_mps <= FASTEST_MPS:
        raise RecordingError(
            f"{drive.path}: its odometry moves at {fastest_mps:.1f} m/s; expected at most "
            f"{FASTEST_MPS:g}: use odometry that does not jump, not a localisation that does"
        )
    return np.stack(views)[inside], found


def save(path: Path, views: NDArray[np.uint8], poses: NDArray[np.float64]) -> int:
    """Write `cbe-train --footage` its file (NumPy's .npz); returns its size in bytes.

    Raises:
        RecordingError: it cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            np.savez_compressed(file, views=views, poses=poses)
        part.replace(path)
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror}; check the path") from error
    return path.stat().st_size
