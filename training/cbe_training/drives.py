"""The demonstrations a run learns from: drives through generated worlds, cached on disk."""

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cbe.robot import Robot
from cbe_hil_sim.clearance import Clearance
from cbe_hil_sim.demonstrator import demonstrate, sample_routes
from cbe_hil_sim.floorplan import from_floorplan
from cbe_hil_sim.generate import VALIDATION_SEEDS, generate
from cbe_hil_sim.tours import HAIRPIN_RAD, roomy, tour
from cbe_hil_sim.world import BIN_SIZE_M, World
from cbe_hil_sim.worldbatch import WorldBatch

SHORTEST_M, LONGEST_M = 8.0, 25.0
TOURED = 0.4  # share of the drives that go on and on, with turns as tight as the car's
BINS = 8  # at most, in a world's twin
BIN_RADIUS_M, BIN_HEIGHT_M = 0.5 * BIN_SIZE_M[0], BIN_SIZE_M[2]
BIN_ASIDE_M = 0.3  # of a drive, at most
BIN_PASS_M = 0.6  # left free on one side at least
BINS_APART_M = 2.0
LOOKS = 4  # of each floor plan
_PLAN_SEEDS = 1_000_000  # of the drives on floor plans: beyond all worlds' seeds
_WORLDS_AT_ONCE = 8  # driven in one lock-step batch

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Drives:
    """Worlds and N drives through them: `poses[i]` (T_i, 3) at 10 Hz in world `world[i]`.

    World `w + twins` is world w with bins on its drives' ways, for repetitions to avoid.
    """

    batch: WorldBatch
    twins: int
    clearance: Clearance
    world: NDArray[np.int64]
    poses: list[NDArray[np.float64]]

    @classmethod
    def build(
        cls, seeds: Sequence[int], per_world: int, cache: Path, plans: Sequence[World] = ()
    ) -> "Drives":
        """Generate the worlds of `seeds` and drive through these and `plans` `per_world` times.

        The poses are kept in `cache`, since driving takes longer than generating.
        """
        worlds = [*(generate(seed) for seed in seeds), *plans]
        seeds = [*seeds, *range(_PLAN_SEEDS, _PLAN_SEEDS + len(plans))]
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
        both = worlds + [
            _with_bins(each, [poses[i] for i in np.flatnonzero(world == index)], seed)
            for index, (each, seed) in enumerate(zip(worlds, seeds, strict=True))
        ]
        return cls(WorldBatch.pack(both), len(worlds), Clearance(both), world, list(poses))


def furnished(plans: Sequence[Path]) -> list[World]:
    """Worlds on the floor plans (map_server's YAML files) at these paths, each in several looks.

    Raises:
        WorldError: a plan cannot be read.
    """
    return [from_floorplan(plan, seed=look) for plan in plans for look in range(LOOKS)]


def unseen(worlds: int, per_world: int, cache: Path) -> Drives:
    """Drives through the first validation worlds, which no run trains on."""
    return Drives.build(VALIDATION_SEEDS[:worlds], per_world, cache)


def cache_name(worlds: list[World], per_world: int) -> str:
    """File name of cached drives: it changes with whatever the robot could run into."""
    digest = hashlib.sha256(f"{per_world} {TOURED}".encode())
    for world in worlds:
        digest.update(world.blocked.tobytes())
    return f"drives-{digest.hexdigest()[:12]}.npz"


def _with_bins(world: World, drives: list[NDArray[np.float64]], seed: int) -> World:
    """The world with bins standing on or just beside some of its drives."""
    rng = np.random.default_rng([seed, 2])
    crowded, standing = world, np.zeros((0, 2))
    for _ in range(BINS if drives else 0):
        path = drives[rng.integers(len(drives))]
        x, y, yaw = path[rng.integers(len(path))]
        left = np.array([-np.sin(yaw), np.cos(yaw)])
        at = np.array([x, y]) + rng.uniform(-BIN_ASIDE_M, BIN_ASIDE_M) * left
        surface = int(rng.integers(len(world.surfaces.texture)))
        passages = at + np.array([[-1.0], [1.0]]) * (BIN_RADIUS_M + BIN_PASS_M / 2) * left
        passable = world.clearance_at(passages).max() > BIN_PASS_M / 2
        apart = np.linalg.norm(standing - at, axis=1).min(initial=np.inf)
        if apart > BINS_APART_M and passable:
            crowded = crowded.with_cylinder(at[0], at[1], BIN_RADIUS_M, BIN_HEIGHT_M, surface)
            standing = np.concatenate([standing, at[None]])
    return crowded


def _drive(
    worlds: list[World], seeds: Sequence[int], per_world: int
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
            toured = round(TOURED * per_world)
            routes = sample_routes(world, per_world - toured, rng, SHORTEST_M, LONGEST_M)
            places = roomy(world)
            ways = [
                tour(world, rng, rng.uniform(SHORTEST_M, LONGEST_M), places, HAIRPIN_RAD)
                for _ in range(toured)
            ]
            routes += [way for way in ways if way is not None]
            paths += routes
            where += [index] * len(routes)
        done = demonstrate(WorldBatch.pack(some), some, np.array(where), paths, robot)
        world_of += [first + drive.world for drive in done]
        poses += [drive.poses for drive in done]
        logger.info("drove %d of %d in worlds up to %d", len(done), len(paths), first + len(some))
    return np.array(world_of, dtype=np.int64), poses
