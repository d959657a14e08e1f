"""What an episode asks for: a demonstrated drive, a start beside its own and perhaps a bin."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cbe.errors import WorldError
from cbe.robot import STEP_S, Robot
from cbe_bench.place import Bin, Place
from cbe_hil_sim.astar import SPACING_M, GoalField
from cbe_hil_sim.demonstrator import ENDPOINT_CLEARANCE_M, demonstrate, sample_routes
from cbe_hil_sim.world import World

GROUP = 10
"""Episodes that share a world, so that it is generated and packed once."""

JITTER_M, JITTER_LIMIT_M = 0.3, 1.0
JITTER_RAD = math.radians(13.5)
START_CLEARANCE_M = 0.08  # from the body's surface: the car cannot back out of a corner
SIGHT_CLEARANCE_M = 0.05  # along the line to the demonstration's start
BIN_MARGIN_SAMPLES = 10
BIN_PASSAGE_M = 0.6
_LEAD_M, _TAIL_M = 1.5, 6.0  # a route is longer than the drive by something between
_ROUNDS, _WORLDS, _TRIES = 6, 4, 100
_LEG_POINTS, _LEG_SHARE, _LEG_TRIES = 20, 0.7, 8
_SHARPEST_RAD = math.radians(150.0)  # turn from leg to leg; what the car cannot drive, fails


@dataclass(frozen=True, slots=True)
class Terms:
    """What all episodes of a run have in common; lengths in steps of 0.1 s."""

    world: str
    steps: int
    seed: int
    jitter_scale: float = 1.0  # 0 starts at the demonstration's own pose
    obstacle_offset_m: float | None = None


@dataclass(frozen=True, slots=True)
class Scenario:
    """One episode before it is driven: `demonstration` (steps + 1, 3) and `start` (3,) poses."""

    index: int
    world_seed: int
    demonstration: NDArray[np.float64]
    start: NDArray[np.float64]
    bin_: Bin | None

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
    tried = [seeds[int(i)] for i in choice.choice(len(seeds), min(_WORLDS, len(seeds)), False)]
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
            f"no drive of {terms.steps} steps found for episodes {missing} in {terms.world} "
            f"(world seeds {tried}); ask for fewer steps or a larger world"
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
        routes = {index: _route(terms, world, streams[index]) for index in missing}
        asked = {index: path for index, path in routes.items() if path is not None}
        if not asked:
            break
        where = np.zeros(len(asked), np.int64)
        for drive in demonstrate(place.batch, [world], where, list(asked.values()), robot):
            index = list(asked)[drive.route]
            rng = streams[index]
            spare = len(drive.poses) - (terms.steps + 1)
            if spare < 0:
                continue
            first = int(rng.integers(0, spare + 1))
            piece = drive.poses[first : first + terms.steps + 1]
            fitted = _fit(terms, world, piece, rng)
            if fitted is not None:
                found[index] = Scenario(index, world_seed, piece, *fitted)
        if len(found) == len(streams):
            break
    return found


def _fit(
    terms: Terms, world: World, piece: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float64], Bin | None] | None:
    """A start and a bin that suit a demonstration, or None."""
    # Streams of their own: with and without a bin the start is drawn alike.
    for_start, for_bin = rng.spawn(2)
    bin_ = None
    if terms.obstacle_offset_m is not None:
        bin_ = _place_bin(world, piece, terms.obstacle_offset_m, for_bin)
        if bin_ is None:
            return None
        world = bin_.in_world(world)
    start = _jitter(world, piece[0], terms.jitter_scale, for_start)
    return None if start is None else (start, bin_)


def _jitter(
    world: World, pose: NDArray[np.float64], scale: float, rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """A start near `pose` (3,), clear of everything and in sight of it, or None."""
    for _ in range(_TRIES):
        offset = rng.normal(0.0, 1.0, 2) * JITTER_M * scale
        offset *= min(1.0, JITTER_LIMIT_M / max(float(np.hypot(*offset)), 1e-9))
        turn_rad = rng.normal() * JITTER_RAD * scale
        start: NDArray[np.float64] = pose + np.array([*offset, turn_rad])
        between = pose[:2] + np.linspace(0.0, 1.0, 21)[:, None] * offset  # (21, 2)
        clearance = world.clearance_at(between)
        body = Robot().body_radius_m
        if clearance[-1] > body + START_CLEARANCE_M and clearance.min() > SIGHT_CLEARANCE_M:
            return start
    return None


def _place_bin(
    world: World, piece: NDArray[np.float64], offset_m: float, rng: np.random.Generator
) -> Bin | None:
    """A bin `offset_m` beside a sample of the path, passable on one side, or None."""
    surface = int(rng.integers(len(world.surfaces.texture)))
    for _ in range(_TRIES):
        sample = int(rng.integers(BIN_MARGIN_SAMPLES, len(piece) - BIN_MARGIN_SAMPLES))
        x, y, yaw = piece[sample]
        left = np.array([-math.sin(yaw), math.cos(yaw)])
        side = 1.0 if rng.random() < 0.5 else -1.0
        centre = np.array([x, y]) + side * offset_m * left
        bin_ = Bin(float(centre[0]), float(centre[1]), surface)
        beside = bin_.radius_m + 0.5 * BIN_PASSAGE_M
        passages = centre + np.array([[beside], [-beside]]) * left  # (2, 2)
        ends = np.hypot(*(piece[[0, -1], :2] - centre).T)  # (2,)
        room = bin_.radius_m + Robot().body_radius_m + START_CLEARANCE_M
        if world.clearance_at(passages).max() >= 0.5 * BIN_PASSAGE_M and ends.min() > room:
            return bin_
    return None


def _route(terms: Terms, world: World, rng: np.random.Generator) -> NDArray[np.float64] | None:
    """A path (N, 2) somewhat longer than the drive that is cut from it, or None."""
    drive_m = terms.steps * STEP_S * Robot().max_speed_mps
    shortest, longest = drive_m + _LEAD_M, drive_m + _TAIL_M
    try:
        return sample_routes(world, 1, rng, shortest, longest)[0]
    except WorldError:
        return _tour(world, rng, shortest)


def _tour(world: World, rng: np.random.Generator, length_m: float) -> NDArray[np.float64] | None:
    """A path (N, 2) through several random places, for worlds too small for a longer way."""
    roomy = world.clearance_m[world.clearance_m >= ENDPOINT_CLEARANCE_M]
    if len(roomy) == 0:
        return None
    # Goals are in the middle of rooms and legs end on their way there: there it goes on ahead.
    free = np.argwhere(world.clearance_m >= np.quantile(roomy, 0.6))[:, ::-1]
    places = (free + 0.5) * world.resolution_m + np.array(world.origin_m)  # (N, 2)
    start, legs, refused = rng.choice(places), list[NDArray[np.float64]](), 0
    for _ in range(_TRIES):
        here = legs[-1][-1] if legs else start
        field = GoalField(world, rng.choice(places))
        reachable = np.isfinite(field.cost_at(here[None])[0])
        leg = field.path(here) if reachable else here[None]
        if len(leg) >= _LEG_POINTS and (not legs or _turn(legs[-1], leg) <= _SHARPEST_RAD):
            legs.append(leg[: max(_LEG_POINTS, round(_LEG_SHARE * len(leg)))])
            refused = 0
            if sum(map(len, legs)) * SPACING_M >= length_m:
                return np.concatenate(legs)
            continue
        refused += 1
        if refused >= _LEG_TRIES:  # a dead end: the last leg leads into a corner
            start, refused = rng.choice(places) if not legs else start, 0
            del legs[-1:]
    return None


def _turn(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Angle between the end of one path and the beginning of the next."""
    a, b = before[-1] - before[-7], after[6] - after[0]
    return abs(math.atan2(float(a[0] * b[1] - a[1] * b[0]), float(a @ b)))
