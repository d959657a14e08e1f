"""The demonstrations a run learns from: drives through generated worlds, cached on disk."""

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cbe.robot import Robot
from cbe_hil_sim.clearance import Clearance
from cbe_hil_sim.demonstrator import demonstrate, sample_routes
from cbe_hil_sim.generate import VALIDATION_SEEDS, generate
from cbe_hil_sim.world import World
from cbe_hil_sim.worldbatch import WorldBatch

SHORTEST_M, LONGEST_M = 8.0, 25.0
_WORLDS_AT_ONCE = 8  # driven in one lock-step batch

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Drives:
    """Worlds and N drives through them: `poses[i]` (T_i, 3) at 10 Hz in world `world[i]`."""

    batch: WorldBatch
    clearance: Clearance
    world: NDArray[np.int64]
    poses: list[NDArray[np.float64]]

    @classmethod
    def build(cls, seeds: range, per_world: int, cache: Path) -> "Drives":
        """Generate the worlds of `seeds` and drive through each `per_world` times.

        The poses are kept in `cache`, since driving takes longer than generating.
        """
        worlds = [generate(seed) for seed in seeds]
        logger.info("generated %d worlds", len(worlds))
        path = cache / cache_name(worlds, per_world)
        if path.exists():
            stored = np.load(path)
            world, flat, length = stored["world"], stored["poses"], stored["length"]
            poses = np.split(flat.astype(np.float64), np.cumsum(length)[:-1])
        else:
            world, poses = _drive(worlds, seeds, per_world)
            cache.mkdir(parents=True, exist_ok=True)
            length = np.array([len(p) for p in poses])
            np.savez_compressed(path, world=world, poses=np.concatenate(poses), length=length)
        logger.info(
            "%d drives, %.0f steps on average", len(poses), np.mean([len(p) for p in poses])
        )
        return cls(WorldBatch.pack(worlds), Clearance(worlds), world, list(poses))


def unseen(worlds: int, per_world: int, cache: Path) -> Drives:
    """Drives through the first validation worlds, which no run trains on."""
    return Drives.build(VALIDATION_SEEDS[:worlds], per_world, cache)


def cache_name(worlds: list[World], per_world: int) -> str:
    """File name of cached drives: it changes with whatever the robot could run into."""
    digest = hashlib.sha256(str(per_world).encode())
    for world in worlds:
        digest.update(world.blocked.tobytes())
    return f"drives-{digest.hexdigest()[:12]}.npz"


def _drive(
    worlds: list[World], seeds: range, per_world: int
) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
    """Drive `per_world` routes in every world: world indices (N,) and poses."""
    robot = Robot()
    world_of: list[int] = []
    poses: list[NDArray[np.float64]] = []
    for first in range(0, len(worlds), _WORLDS_AT_ONCE):
        some = worlds[first : first + _WORLDS_AT_ONCE]
        paths, where = [], []
        for index, world in enumerate(some):
            rng = np.random.default_rng([seeds[first + index], 1])
            routes = sample_routes(world, per_world, rng, SHORTEST_M, LONGEST_M)
            paths += routes
            where += [index] * len(routes)
        done = demonstrate(WorldBatch.pack(some), some, np.array(where), paths, robot)
        world_of += [first + drive.world for drive in done]
        poses += [drive.poses for drive in done]
        logger.info("drove %d of %d in worlds up to %d", len(done), len(paths), first + len(some))
    return np.array(world_of, dtype=np.int64), poses
