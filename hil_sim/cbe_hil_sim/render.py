"""Camera images of 2.5-D worlds: each image column is one march over the grid."""

import numpy as np
from numpy.typing import NDArray

from cbe.camera import CameraModel
from cbe.errors import CameraError
from cbe.robot import Robot
from cbe_hil_sim.march import render_images
from cbe_hil_sim.worldbatch import WorldBatch


def render(
    batch: WorldBatch,
    world_index: NDArray[np.integer],
    pose: NDArray[np.floating],
    camera: CameraModel,
    *,
    supersample: int = 2,
    height_m: NDArray[np.floating] | None = None,
    pitch_px: NDArray[np.floating] | None = None,
    robot: Robot | None = None,
) -> NDArray[np.uint8]:
    """Render what B robots at `pose` (B, 3) in worlds `world_index` (B,) see, RGB (B, h, w, 3).

    The camera looks level and forward from the robot's mast; `height_m` (B,) replaces the
    mast's height, `pitch_px` (B,) moves the horizon down by so many pixels. Each pixel is the
    mean of `supersample` x `supersample` rays. Outside its grid a world is solid.

    Raises CameraError for a distorted camera or no rays and WorldError for bad indices or poses.
    """
    if camera.model != "pinhole" or any(camera.distortion):
        raise CameraError(
            f"the column renderer draws undistorted pinhole views; found {camera.model!r} with "
            f"distortion {camera.distortion}; render a pinhole view and remap it"
        )
    if supersample < 1:
        raise CameraError(f"supersample is {supersample}; expected 1, 2 or more rays a side")
    world_index = np.asarray(world_index, np.int64)
    camera_pose = np.array(pose, np.float64)
    batch.check(world_index, camera_pose)
    mast = robot or Robot()
    camera_pose[:, 0] += mast.camera_x_m * np.cos(camera_pose[:, 2])
    camera_pose[:, 1] += mast.camera_x_m * np.sin(camera_pose[:, 2])
    count = len(world_index)
    camera_z_m = np.full(count, mast.camera_height_m)
    if height_m is not None:
        camera_z_m[:] = height_m
    horizon_px = np.full(count, float(camera.cy))
    if pitch_px is not None:
        horizon_px += pitch_px
    order = np.argsort(world_index, kind="stable")  # a world's textures stay in the cache
    images = np.empty((count, camera.height, camera.width, 3), np.uint8)
    render_images(
        batch, world_index, order, camera_pose, camera_z_m, horizon_px, float(camera.fx),
        float(camera.fy), float(camera.cx), supersample, images,
    )  # fmt: skip
    return images
