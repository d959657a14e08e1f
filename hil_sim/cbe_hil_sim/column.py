"""Column backend: B robots in 2.5-D worlds, seen by the column renderer and the scanner."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA, CameraModel
from cbe.errors import WorldError
from cbe.robot import Robot
from cbe_hil_sim.backend import Observation
from cbe_hil_sim.clearance import Clearance
from cbe_hil_sim.render import render
from cbe_hil_sim.scanner import scan
from cbe_hil_sim.vehicle import Vehicle
from cbe_hil_sim.world import World
from cbe_hil_sim.worldbatch import WorldBatch


class ColumnBackend:
    """`Backend` without physics: kinematic cars that may drive through walls, but get noted."""

    def __init__(
        self,
        worlds: Sequence[World],
        world_index: NDArray[np.integer],
        *,
        batch: WorldBatch | None = None,
        robot: Robot | None = None,
        camera: CameraModel = MODEL_CAMERA,
        supersample: int = 2,
        noise: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Robot b lives in `worlds[world_index[b]]`; `batch` saves packing the worlds again.

        `noise` is the actuation noise as in `Vehicle`. `reset` before anything else.
        """
        self.robot = robot or Robot()
        self.camera = camera
        self.world_index = np.asarray(world_index, dtype=np.int64)
        if (
            self.world_index.size
            and not 0 <= self.world_index.min() <= self.world_index.max() < len(worlds)
        ):
            raise WorldError(
                f"world_index {self.world_index.min()} to {self.world_index.max()} does not fit "
                f"{len(worlds)} worlds"
            )
        self._batch = batch if batch is not None else WorldBatch.pack(worlds)
        self._clearance = Clearance(worlds)
        self._supersample = supersample
        robots = len(self.world_index)
        self.vehicle = Vehicle(np.zeros((robots, 3)), self.robot, noise=noise, rng=rng)
        self._collided = np.zeros(robots, np.bool_)

    @property
    def poses(self) -> NDArray[np.float64]:
        """World poses of base_link (B, 3), a copy."""
        return self.vehicle.poses.copy()

    @property
    def clearance_m(self) -> NDArray[np.float32]:
        """Distance from each body's surface to the nearest obstacle, (B,)."""
        distance = self._clearance.at(self.world_index, self.vehicle.poses[:, :2])
        return np.asarray(distance - np.float32(self.robot.body_radius_m))

    @property
    def collided(self) -> NDArray[np.bool_]:
        """Whether each body has touched something since the last reset, (B,)."""
        return self._collided.copy()

    def reset(self, poses: NDArray[np.float64]) -> None:
        """Put the robots at rest at world poses (B, 3)."""
        if poses.shape != (len(self.world_index), 3):
            raise WorldError(
                f"reset needs poses ({len(self.world_index)}, 3), one a robot; found {poses.shape}"
            )
        self.vehicle.reset(poses)
        self._collided = self.clearance_m < 0.0

    def observe(self) -> Observation:
        """Render cameras and scans at the present poses."""
        poses = self.vehicle.poses
        images = render(
            self._batch, self.world_index, poses, self.camera, supersample=self._supersample
        )
        return Observation(images, scan(self._batch, self.world_index, poses, self.robot))

    def step(self, speed_mps: NDArray[np.float64], yaw_rate_rad_s: NDArray[np.float64]) -> None:
        """Advance 0.1 s under the commanded twists, each (B,)."""
        self.vehicle.step(speed_mps, yaw_rate_rad_s)
        self._collided |= self.clearance_m < 0.0
