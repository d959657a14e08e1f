"""The one world of a robot process: opened by name, driven in on either backend."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cbe.camera import CameraModel
from cbe.errors import ConfigError
from cbe_hil_sim.backend import Backend
from cbe_hil_sim.world import BIN_SIZE_M, World

if TYPE_CHECKING:
    from cbe_hil_sim.bullet import BulletBackend

PLAN_SUFFIXES = (".yaml", ".yml")
BACKENDS = ("bullet", "column")
BIN_RGB = (70, 80, 90)


class SimWorld:
    """`backend` with one robot, and `planning`, the world to seek paths in. Close it."""

    backend: Backend
    planning: World

    def __init__(
        self, source: int | Path, kind: str, camera: CameraModel, *, gui: bool = False
    ) -> None:
        """Open a generated world by its seed, a floor plan's YAML file or a mesh scene's folder.

        ConfigError for what the backend cannot show, WorldError for what cannot be loaded.
        """
        self.camera = camera
        self._bullet: BulletBackend | None = None
        if kind == "bullet":
            self._open_bullet(source, gui)
        elif gui or (isinstance(source, Path) and source.is_dir()):
            raise ConfigError("scenes and the window need --backend bullet")
        else:
            self.planning = _world(source)
            self._open_column()

    def place_bin(self, pose: NDArray[np.float64]) -> None:
        """Stand the paper's bin at a world pose (3,); the robot keeps its own pose, at rest."""
        if self._bullet is not None:
            image = np.full((4, 4, 3), BIN_RGB, np.uint8)
            self._bullet.place_box(pose, BIN_SIZE_M, image)
        else:
            radius = 0.5 * BIN_SIZE_M[0]
            self.planning = self.planning.with_cylinder(
                float(pose[0]), float(pose[1]), radius, BIN_SIZE_M[2], 0
            )
            poses = self.backend.poses
            self._open_column()
            self.backend.reset(poses)

    def roomiest_pose(self) -> NDArray[np.float64]:
        """Pose (3,) with the most space round it."""
        world = self.planning
        row, column = np.unravel_index(world.clearance_m.argmax(), world.clearance_m.shape)
        x, y = (np.array([column, row]) + 0.5) * world.resolution_m + world.origin_m
        return np.array([x, y, 0.0])

    def close(self) -> None:
        """Release pybullet's memory."""
        if self._bullet is not None:
            self._bullet.close()

    def _open_column(self) -> None:
        import numba

        from cbe_hil_sim.column import ColumnBackend

        # One robot gives a pool nothing to share, and waiting for its threads stalls a busy board.
        numba.set_num_threads(1)
        self.backend = ColumnBackend([self.planning], np.zeros(1, np.int64), camera=self.camera)

    def _open_bullet(self, source: int | Path, gui: bool) -> None:
        try:
            from cbe_hil_sim.bullet import BulletBackend
        except ModuleNotFoundError:
            raise ConfigError(
                "pybullet is not installed (it has a wheel for x86-64 Linux and Python 3.11 "
                "alone); use --backend column"
            ) from None
        from cbe_hil_sim.bulletscene import scene_from_world
        from cbe_hil_sim.meshscene import load_scene

        if isinstance(source, Path) and source.suffix not in PLAN_SUFFIXES:
            scene = load_scene(source)
        else:
            scene = scene_from_world(_world(source))
        self._bullet = BulletBackend(scene, camera=self.camera, gui=gui)
        self.backend, self.planning = self._bullet, scene.planning


def _world(source: int | Path) -> World:
    """The generated world or the floor plan's."""
    if isinstance(source, Path):
        from cbe_hil_sim.floorplan import from_floorplan

        return from_floorplan(source)
    from cbe_hil_sim.generate import generate

    return generate(source)
