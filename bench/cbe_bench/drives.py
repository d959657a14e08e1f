"""The ways that demonstrations take: pieces of a fixed length, or journeys from room to room."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cbe.errors import ConfigError, WorldError
from cbe.robot import STEP_S, Robot
from cbe_bench.rooms import rooms
from cbe_hil_sim.astar import SPACING_M, GoalField
from cbe_hil_sim.demonstrator import ENDPOINT_CLEARANCE_M, PATH_CLEARANCE_M, sample_routes
from cbe_hil_sim.tours import HAIRPIN_RAD, SHARPEST_RAD, middles, roomy, tour
from cbe_hil_sim.world import World

LENGTH_SPREAD = 0.15  # a journey's length is drawn from so much below and above that asked for,
END_SPREAD = 0.05  # and met so well
_LEAD_M, _TAIL_M = 1.5, 6.0  # a path is longer than the piece by something between
_STARTS, _ENDS, _TOURS = 6, 3, 6


class Drives(Protocol):
    """What kind of drive is demonstrated."""

    @property
    def shortest_steps(self) -> int:
        """No drive has fewer steps of 0.1 s."""

    def path(self, world: World, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """A path (N, 2) to demonstrate, a point each 0.05 m, or None."""

    def part(
        self, poses: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """What is used of the demonstrated poses (T, 3), or None where they do not suit."""


@dataclass(frozen=True, slots=True)
class Pieces:
    """Drives of exactly so many steps, cut from longer ones, hence begun and ended moving."""

    steps: int

    def __str__(self) -> str:
        return f"{self.steps} steps"

    @property
    def shortest_steps(self) -> int:
        """See `Drives`."""
        return self.steps

    def path(self, world: World, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """A path (N, 2) somewhat longer than the piece that is cut from it, or None."""
        piece_m = self.steps * STEP_S * Robot().max_speed_mps
        shortest, longest = piece_m + _LEAD_M, piece_m + _TAIL_M
        try:
            return sample_routes(world, 1, rng, shortest, longest)[0]
        except WorldError:
            places = roomy(world)
            gentle = tour(world, rng, shortest, places)
            return tour(world, rng, shortest, places, HAIRPIN_RAD) if gentle is None else gentle

    def part(
        self, poses: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """See `Drives`."""
        spare = len(poses) - (self.steps + 1)
        if spare < 0:
            return None
        first = int(rng.integers(0, spare + 1))
        return poses[first : first + self.steps + 1]


@dataclass(frozen=True, slots=True)
class Journeys:
    """Whole drives of about a length, from one room to another (paper, Sec. IV-C).

    A world too small for a straight way of that length is toured; one without rooms is driven
    from anywhere to anywhere. With `hairpins` tours turn back in passages too, at the car's limit.
    """

    length_m: float
    hairpins: bool = False

    def __post_init__(self) -> None:
        """Refuse lengths that are none."""
        if not 1.0 <= self.length_m < math.inf:
            raise ConfigError(f"a drive is at least 1 m long, found {self.length_m}")

    def __str__(self) -> str:
        return f"about {self.length_m:g} m"

    @property
    def shortest_steps(self) -> int:
        """See `Drives`."""
        shortest_m = (1.0 - LENGTH_SPREAD) * (1.0 - END_SPREAD) * self.length_m
        return int(shortest_m / (STEP_S * Robot().max_speed_mps))

    def path(self, world: World, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """See `Drives`."""
        room = rooms(world)
        within = (world.clearance_m >= ENDPOINT_CLEARANCE_M) & (room > 0)
        places = middles(world, within) if within.any() else roomy(world)
        if len(places) == 0:
            return None
        sharpest_rad = HAIRPIN_RAD if self.hairpins else SHARPEST_RAD
        length_m = self.length_m * (1.0 + rng.uniform(-LENGTH_SPREAD, LENGTH_SPREAD))
        low, high = length_m * (1.0 - END_SPREAD), length_m * (1.0 + END_SPREAD)
        for way in _ways(world, rng, low, high, places, sharpest_rad):
            numbers = room[world.cells(way)]  # (N,)
            away = (numbers != numbers[0]) & (numbers > 0) if room.max() > 1 else numbers >= 0
            away &= world.clearance_at(way) >= ENDPOINT_CLEARANCE_M
            away[: math.ceil(low / SPACING_M)] = False
            away[math.floor(high / SPACING_M) + 1 :] = False
            if away.any():
                path = way[: 1 + int(rng.choice(np.flatnonzero(away)))]
                if world.clearance_at(path).min() >= PATH_CLEARANCE_M:
                    return path
        return None

    def part(
        self, poses: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """All of the drive, unless the car went in circles on its way."""
        longest_m = (1.0 + LENGTH_SPREAD) * (1.0 + END_SPREAD) * self.length_m
        driven_m = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
        return poses if driven_m <= longest_m else None


def _ways(
    world: World,
    rng: np.random.Generator,
    low_m: float,
    high_m: float,
    places: NDArray[np.float64],
    sharpest_rad: float,
) -> Iterator[NDArray[np.float64]]:
    """Paths (N, 2) from some of the `places` (K, 2) on: straight ones, then tours."""
    for start in rng.choice(places, _STARTS):
        field = GoalField(world, start)
        cost = field.cost_at(places)  # never below the distance
        far = places[np.isfinite(cost) & (cost >= low_m)]
        for end in rng.choice(far, _ENDS) if len(far) else far:
            yield field.path(end)[::-1]
    for _ in range(_TOURS):
        way = tour(world, rng, high_m, places, sharpest_rad)
        if way is not None:
            yield way
