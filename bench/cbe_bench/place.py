"""Places to drive in: generated worlds of a split, a floor plan or a mesh scene."""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA, CameraModel, Preprocessor
from cbe.errors import ConfigError
from cbe_hil_sim.backend import Backend
from cbe_hil_sim.column import ColumnBackend
from cbe_hil_sim.generate import TEST_SEEDS, VALIDATION_SEEDS, generate
from cbe_hil_sim.world import World
from cbe_hil_sim.worldbatch import WorldBatch

if TYPE_CHECKING:
    from cbe_hil_sim.bullet import BulletBackend
    from cbe_hil_sim.scene import Scene

GENERATED = {"val": VALIDATION_SEEDS, "test": TEST_SEEDS}
BACKENDS = ("column", "bullet")
BIN_SIDES = 24
BIN_IMAGE = np.full((8, 8, 3), (96, 104, 112), np.uint8)  # grey, as the paper's

See = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
"""From the camera's image to the networks' view (64, 64, 3)."""


@dataclass(frozen=True, slots=True)
class Bin:
    """An upright cylinder beside a path, standing on the floor."""

    x_m: float
    y_m: float
    surface: int
    radius_m: float = 0.15
    height_m: float = 1.0

    def in_world(self, world: World) -> World:
        """The world with the bin in it."""
        return world.with_cylinder(self.x_m, self.y_m, self.radius_m, self.height_m, self.surface)


def world_seeds(world: str, chosen: range | None) -> Sequence[int]:
    """Seeds of the worlds that episodes take place in; one for a scene or a floor plan.

    ConfigError where `chosen` leaves the split's own seeds or names a scene's.
    """
    split = GENERATED.get(world)
    if split is None:
        if chosen is not None:
            raise ConfigError(f"--world-seeds belongs to --world val or test, not to {world}")
        if not Path(world).exists():
            raise ConfigError(
                f"no world {world!r}: give val, test, a scene's folder or a floor plan's YAML file"
            )
        return range(1)
    if chosen is None:
        return split
    if len(chosen) == 0 or chosen[0] not in split or chosen[-1] not in split:
        raise ConfigError(
            f"--world-seeds {chosen.start}:{chosen.stop} is not within the {world} seeds "
            f"{split.start}:{split.stop}"
        )
    return chosen


def is_scene(world: str) -> bool:
    """Whether `world` names a mesh scene's folder."""
    return world not in GENERATED and Path(world).is_dir()


class Place:
    """One world to plan and drive in; close it, since pybullet holds memory of its own.

    `world` is what paths are sought in, of a mesh scene its free space.
    """

    def __init__(
        self, name: str, seed: int, kind: str = "column", camera: CameraModel | None = None
    ) -> None:
        """Open the world `seed` of a split, or the scene or floor plan at a path.

        Without a `camera` the robot has one that sees just the networks' view.

        Raises:
            WorldError: it cannot be loaded.
        """
        self._kind, self._camera = kind, camera
        self._scene: Scene | None = None
        if name in GENERATED:
            self.world = generate(seed)
        elif is_scene(name):
            self._scene = _load_scene(Path(name))
            self.world = self._scene.planning
        else:
            self.world = _load_plan(Path(name))
        self.batch = WorldBatch.pack([self.world])
        self._bullet: BulletBackend | None = None

    @contextmanager
    def backend(
        self,
        *,
        noise: float = 0.0,
        rng: np.random.Generator | None = None,
        bins: Sequence[Bin] = (),
    ) -> Iterator[tuple[Backend, See]]:
        """One robot's backend, with what turns its images into the networks' view.

        `noise` and `rng` as in `Vehicle`; pybullet's car, which slips by itself, takes none.
        """
        if self._kind == "column":
            world, batch = _with_bins(self.world, bins), None if bins else self.batch
            camera = self._camera or MODEL_CAMERA
            backend = ColumnBackend(
                [world], np.zeros(1, np.int64), batch=batch, camera=camera, noise=noise, rng=rng
            )
            yield backend, _see(camera)
        elif not bins:
            if self._bullet is None:
                self._bullet = self._load_bullet(())
            yield self._bullet, _see(self._bullet.camera)
        else:
            with self._load_bullet(bins) as bullet:
                yield bullet, _see(bullet.camera)

    def close(self) -> None:
        """Release what pybullet holds."""
        if self._bullet is not None:
            self._bullet.close()
            self._bullet = None

    def _load_bullet(self, bins: Sequence[Bin]) -> "BulletBackend":
        from cbe_hil_sim.bullet import SIM_CAMERA, BulletBackend
        from cbe_hil_sim.bulletscene import scene_from_world

        if self._scene is None:
            scene = scene_from_world(_with_bins(self.world, bins))
        else:
            scene = functools.reduce(_stand_in, bins, self._scene)
        return BulletBackend(scene, camera=self._camera or SIM_CAMERA)


@functools.lru_cache(maxsize=1)
def _see(camera: CameraModel) -> See:
    """Cached, for all episodes share a camera whose maps take milliseconds to build."""
    return Preprocessor(camera)


@functools.lru_cache(maxsize=1)
def _load_scene(folder: Path) -> "Scene":
    """Cached, for groups of episodes share a scene that takes seconds to load."""
    from cbe_hil_sim.meshscene import load_scene

    return load_scene(folder)


@functools.lru_cache(maxsize=1)
def _load_plan(path: Path) -> World:
    from cbe_hil_sim.floorplan import from_floorplan

    return from_floorplan(path)


def _with_bins(world: World, bins: Sequence[Bin]) -> World:
    for bin_ in bins:
        world = bin_.in_world(world)
    return world


def _stand_in(scene: "Scene", bin_: Bin) -> "Scene":
    """The scene with a plain bin standing in it."""
    from cbe_hil_sim.scene import Patch

    angle = np.linspace(0.0, 2.0 * np.pi, BIN_SIDES + 1)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * bin_.radius_m
    rim += (bin_.x_m, bin_.y_m)
    low = np.column_stack([rim, np.zeros(len(rim))])
    high = np.column_stack([rim, np.full(len(rim), bin_.height_m)])
    middle = np.broadcast_to((bin_.x_m, bin_.y_m, bin_.height_m), high[:-1].shape)
    corners = np.concatenate(
        [
            np.stack([low[:-1], low[1:], high[1:]], axis=1),
            np.stack([low[:-1], high[1:], high[:-1]], axis=1),
            np.stack([high[:-1], high[1:], middle], axis=1),
        ]
    ).astype(np.float32)  # (3 * sides, 3, 3)
    plain = Patch(corners, np.zeros((len(corners), 3, 2), np.float32), BIN_IMAGE)
    return replace(
        scene,
        patches=[*scene.patches, plain],
        solid_m=np.concatenate([scene.solid_m, corners]),
        planning=bin_.in_world(scene.planning),
    )
