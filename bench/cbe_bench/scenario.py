"""What an episode asks for: a demonstrated drive, a start beside its own and perhaps bins."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cbe.errors import WorldError
from cbe.robot import Robot
from cbe_bench.drives import Drives
from cbe_bench.jitter import CLEARANCE_M, jittered
from cbe_bench.place import Bin, Place
from cbe_hil_sim.demonstrator import demonstrate
from cbe_hil_sim.world import World

GROUP = 10
"""Episodes that share a world, so that it is generated and packed once."""

BIN_MARGIN_SAMPLES = 10
BIN_PASSAGE_M = 0.6
BIN_APART_M = 1.5  # from bin to bin, so that the car gets past one side and then the other
_ROUNDS, _DRAWS, _WORLDS, _TRIES = 6, 8, 4, 100


@dataclass(frozen=True, slots=True)
class Terms:
    """What all episodes of a run have in common."""

    world: str
    drives: Drives
    seed: int
    jitter_scale: float = 1.0  # 0 starts at the demonstration's own pose
    obstacles: int = 0  # bins, each so far beside the path:
    obstacle_offset_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """One episode before it is driven: `demonstration` (T, 3) one a step, and `start` (3,) pose."""

    index: int
    world_seed: int
    demonstration: NDArray[np.float64]
    start: NDArray[np.float64]
    bins: tuple[Bin, ...]

    @property
    def length_m(self) -> float:
        """Distance driven in the demonstration."""
        return float(np.hypot(*np.diff(self.demonstration[:, :2], axis=0).T).sum())


def scenarios(
    terms: Terms, group: int, count: int, seeds: Sequence[int], open_: Callable[[int], Place]
) -> list[tuple[Place, Scenario]]:
    """The first `count` episodes of a group with their places (without bins).

    They depend on `terms`, the group's number and `seeds` alone, not on how many are asked for.
    A world that does not yield them all passes the rest on to another. `open_` opens the place
    of a world seed.

    Raises:
        WorldError: no world tried yields a drive of that length with a start beside it.
    """
    choice = np.random.default_rng([terms.seed, group])
    tried = [
        seeds[int(i)]
        for _ in range(_DRAWS)
        for i in choice.choice(len(seeds), min(_WORLDS, len(seeds)), False)
    ]
    indices = [group * GROUP + member for member in range(GROUP)]
    streams = {index: np.random.default_rng([terms.seed, group, index]) for index in indices}
    found: dict[int, tuple[Place, Scenario]] = {}
    for world_seed in tried:
        place = open_(world_seed)
        for index, scenario in _in_place(terms, place, world_seed, streams).items():
            found[index] = (place, scenario)
            del streams[index]
        if not streams:
            break
    missing = [index for index in indices[:count] if index not in found]
    if missing:
        raise WorldError(
            f"no drive of {terms.drives} found for episodes {missing} in {terms.world} "
            f"(world seeds {tried}); ask for a shorter one, a larger world, or --hairpins (route)"
        )
    return [found[index] for index in indices[:count]]


def _in_place(
    terms: Terms, place: Place, world_seed: int, streams: dict[int, np.random.Generator]
) -> dict[int, Scenario]:
    """As many of the episodes that `streams` are for as this place yields."""
    robot, world = Robot(), place.world
    found: dict[int, Scenario] = {}
    for _ in range(_ROUNDS):
        missing = [index for index in streams if index not in found]
        paths = {index: terms.drives.path(world, streams[index]) for index in missing}
        asked = {index: path for index, path in paths.items() if path is not None}
        if not asked:
            break
        where = np.zeros(len(asked), np.int64)
        for drive in demonstrate(place.batch, [world], where, list(asked.values()), robot):
            index = list(asked)[drive.route]
            rng = streams[index]
            part = terms.drives.part(drive.poses, rng)
            if part is None:
                continue
            fitted = _fit(terms, place, part, rng)
            if fitted is not None:
                found[index] = Scenario(index, world_seed, part, *fitted)
        if len(found) == len(streams):
            break
    return found


def _fit(
    terms: Terms, place: Place, drive: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float64], tuple[Bin, ...]] | None:
    """A start and bins that suit a demonstration (T, 3), or None."""
    # Streams of their own: with and without bins the start is drawn alike.
    for_start, for_bins = rng.spawn(2)
    world, bins = place.world, tuple[Bin, ...]()
    for _ in range(terms.obstacles):
        bin_ = _place_bin(world, drive, terms.obstacle_offset_m, bins, for_bins)
        if bin_ is None:
            return None
        bins, world = (*bins, bin_), bin_.in_world(world)
    start = jittered(world, place.batch, drive[0], terms.jitter_scale, for_start)
    return None if start is None else (start, bins)


def _place_bin(
    world: World,
    drive: NDArray[np.float64],
    offset_m: float,
    others: Sequence[Bin],
    rng: np.random.Generator,
) -> Bin | None:
    """A bin `offset_m` beside a sample of the path, passable on one side, or None."""
    surface = int(rng.integers(len(world.surfaces.texture)))
    for _ in range(_TRIES):
        sample = int(rng.integers(BIN_MARGIN_SAMPLES, len(drive) - BIN_MARGIN_SAMPLES))
        x, y, yaw = drive[sample]
        left = np.array([-math.sin(yaw), math.cos(yaw)])
        side = 1.0 if rng.random() < 0.5 else -1.0
        centre = np.array([x, y]) + side * offset_m * left
        bin_ = Bin(float(centre[0]), float(centre[1]), surface)
        beside = bin_.radius_m + 0.5 * BIN_PASSAGE_M
        passages = centre + np.array([[beside], [-beside]]) * left  # (2, 2)
        ends = np.hypot(*(drive[[0, -1], :2] - centre).T)  # (2,)
        room = bin_.radius_m + Robot().body_radius_m + CLEARANCE_M
        apart = all(math.dist(centre, (o.x_m, o.y_m)) >= BIN_APART_M for o in others)
        passable = world.clearance_at(passages).max() >= 0.5 * BIN_PASSAGE_M
        if apart and passable and ends.min() > room:
            return bin_
    return None
