"""pybullet backend: one car under real physics, TinyRenderer camera and ray lidar."""

import math
from types import TracebackType
from typing import Self

import numpy as np
import pybullet
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA, CameraModel
from cbe.controller import motion_from_twist
from cbe.errors import CameraError, WorldError
from cbe.geometry import from_frame
from cbe.robot import Robot
from cbe_hil_sim.backend import Observation
from cbe_hil_sim.car import SOLID, SOLID_MASK, SUBSTEPS, TIME_STEP_S, Car
from cbe_hil_sim.scene import Patch, Scene, solidify
from cbe_hil_sim.world import BLOCKING_HEIGHT_M

SIM_CAMERA = MODEL_CAMERA.scaled(160, 120)
"""The simulator's camera: the networks' view in an ordinary size."""

NEAR_M, FAR_M = 0.02, 60.0
CLEARANCE_REACH_M = 1.0  # how far the nearest obstacle is sought


class BulletBackend:
    """`Backend` of one robot (B = 1) in a pybullet client of its own. Use as a context or close.

    Pictures come from a second client, since hundreds of textured bodies slow the physics down.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        robot: Robot | None = None,
        camera: CameraModel = SIM_CAMERA,
        supersample: int = 1,
        gui: bool = False,
    ) -> None:
        """Load the scene and the car; `gui` opens pybullet's window.

        Each pixel is the mean of `supersample` x `supersample`. CameraError for a camera other
        than an undistorted pinhole.
        """
        if camera.model != "pinhole" or any(camera.distortion):
            raise CameraError(
                f"pybullet draws undistorted pinhole views; found {camera.model!r} with "
                f"distortion {camera.distortion}; render a pinhole view and remap it"
            )
        self.scene = scene
        self.robot = robot = robot or Robot()
        self.camera = camera
        self._drawn = camera.scaled(camera.width * supersample, camera.height * supersample)
        self._supersample = supersample
        self._clients = [pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)]
        self._physics = self._clients[0]
        if gui:
            self._eye = self._physics
        else:
            self._eye = pybullet.connect(pybullet.DIRECT)
            self._clients.append(self._eye)
        for patch in scene.patches:
            patch.show(self._eye, double_sided=scene.double_sided)
        self._solids: list[int] = []
        self._solidify(scene.solid_m)
        self.car = Car(self._physics, robot)
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=self._physics)
        pybullet.setTimeStep(TIME_STEP_S, physicsClientId=self._physics)
        self._projection = _projection(camera)
        angle = robot.scan_angle_min_rad
        angles = angle + np.arange(robot.scan_rays) * robot.scan_angle_increment_rad
        sensor = np.array([robot.scan_x_m, 0.0])
        reach = robot.scan_range_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        self._rays = np.stack([np.broadcast_to(sensor, reach.shape), sensor + reach])  # (2, R, 2)
        self._collided = False

    @property
    def poses(self) -> NDArray[np.float64]:
        """World pose of base_link, (1, 3)."""
        return self.car.pose[None]

    @property
    def clearance_m(self) -> NDArray[np.float32]:
        """Distance from the body to the nearest solid, (1,); below 0 in contact.

        inf beyond `CLEARANCE_REACH_M`.
        """
        nearest = math.inf
        for solid in self._solids:
            points = pybullet.getClosestPoints(
                self.car.body, solid, CLEARANCE_REACH_M, self.car.body_link, -1,
                physicsClientId=self._physics,
            )  # fmt: skip
            nearest = min([nearest, *(point[8] for point in points)])
        return np.array([nearest], np.float32)

    @property
    def collided(self) -> NDArray[np.bool_]:
        """Whether the body has touched a solid since the last reset, (1,)."""
        return np.array([self._collided])

    def reset(self, poses: NDArray[np.float64]) -> None:
        """Put the robot at rest at a world pose (1, 3)."""
        if poses.shape != (1, 3) or not np.isfinite(poses).all():
            raise WorldError(f"reset needs one finite pose (1, 3); found {poses.tolist()}")
        self.car.reset(poses[0])
        pybullet.performCollisionDetection(physicsClientId=self._physics)
        self._collided = bool(self.clearance_m[0] < 0.0)

    def observe(self) -> Observation:
        """Render the camera and the scan at the present pose."""
        return Observation(self._image()[None], self._scan()[None])

    def step(self, speed_mps: NDArray[np.float64], yaw_rate_rad_s: NDArray[np.float64]) -> None:
        """Advance 0.1 s under the commanded twist, each (1,)."""
        held = np.array([self.car.steer_rad])
        target = motion_from_twist(
            np.asarray(speed_mps, np.float64), np.asarray(yaw_rate_rad_s, np.float64), held,
            self.robot,
        )  # fmt: skip
        speed = min(max(float(target.speed_mps[0]), 0.0), self.robot.max_speed_mps)
        for _ in range(SUBSTEPS):
            self.car.drive(speed, float(target.steer_rad[0]))
            pybullet.stepSimulation(physicsClientId=self._physics)
            self._collided = self._collided or self._touches()

    def place_box(
        self,
        pose: NDArray[np.floating],
        size_m: tuple[float, float, float],
        image: NDArray[np.uint8],
    ) -> None:
        """Stand a box on the floor at a world pose (3,), a picture (h, w, 3) on every face."""
        patch = Patch.box(pose, size_m, image)
        patch.show(self._eye)
        self._solidify(patch.corners_m)

    def close(self) -> None:
        """Release pybullet's memory; the backend is unusable afterwards."""
        for client in self._clients:
            pybullet.disconnect(client)
        self._clients = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _solidify(self, solid_m: NDArray[np.float32]) -> None:
        # What the mast passes under matters neither to the body nor to the scan below.
        low = solid_m[solid_m[..., 2].min(axis=1) < BLOCKING_HEIGHT_M]
        for body in solidify(low, self._physics):
            pybullet.setCollisionFilterGroupMask(
                body, -1, SOLID, SOLID_MASK, physicsClientId=self._physics
            )
            self._solids.append(body)

    def _touches(self) -> bool:
        contacts = pybullet.getContactPoints(
            bodyA=self.car.body, linkIndexA=self.car.body_link, physicsClientId=self._physics
        )
        return any(contact[8] <= 0.0 for contact in contacts)

    def _image(self) -> NDArray[np.uint8]:
        """What the camera sees, RGB (height, width, 3)."""
        x, y, yaw = self.car.pose
        cos, sin, z = math.cos(yaw), math.sin(yaw), self.robot.camera_height_m
        eye = [x + self.robot.camera_x_m * cos, y + self.robot.camera_x_m * sin, z]
        view = pybullet.computeViewMatrix(eye, [eye[0] + cos, eye[1] + sin, z], [0.0, 0.0, 1.0])
        pixels = pybullet.getCameraImage(
            self._drawn.width, self._drawn.height, view, self._projection,
            lightDirection=[1.0, 2.0, 4.0], lightAmbientCoeff=self.scene.ambient,
            lightDiffuseCoeff=1.0 - self.scene.ambient, lightSpecularCoeff=0.0, shadow=0,
            renderer=pybullet.ER_TINY_RENDERER, flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._eye,
        )[2]  # fmt: skip
        shape = (self._drawn.height, self._drawn.width, 4)
        image = np.asarray(pixels, np.uint8).reshape(shape)[..., :3]
        if self._supersample == 1:
            return np.ascontiguousarray(image)
        fine = (self.camera.height, self._supersample, self.camera.width, self._supersample, 3)
        mean = image.reshape(fine).mean(axis=(1, 3))  # (h, w, 3)
        return np.asarray(np.rint(mean), np.uint8)

    def _scan(self) -> NDArray[np.float32]:
        """Distances (rays,) in metres, +inf without a return."""
        rays = from_frame(self.car.pose, self._rays)  # (2, R, 2)
        height = np.full((*rays.shape[:2], 1), self.robot.scan_height_m)
        start, end = np.concatenate([rays, height], axis=-1).tolist()
        hits = pybullet.rayTestBatch(
            start, end, collisionFilterMask=SOLID, physicsClientId=self._physics
        )
        share = np.array([hit[2] if hit[0] >= 0 else np.inf for hit in hits], np.float32)
        return share * np.float32(self.robot.scan_range_m)


def _projection(camera: CameraModel) -> list[float]:
    """OpenGL projection matrix (16, column by column) of a pinhole camera."""
    scale = NEAR_M
    return list(
        pybullet.computeProjectionMatrix(
            left=-camera.cx / camera.fx * scale,
            right=(camera.width - camera.cx) / camera.fx * scale,
            bottom=-(camera.height - camera.cy) / camera.fy * scale,
            top=camera.cy / camera.fy * scale,
            nearVal=NEAR_M,
            farVal=FAR_M,
        )
    )
