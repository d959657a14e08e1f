"""Joining is judged by where the robot truly was when it said that it knew."""

import json
import math

import numpy as np
import pytest

from cbe_bench import join
from cbe_bench.cli import main
from cbe_bench.episode import Outcome
from cbe_bench.join import OFF_M, OFF_RAD, Joined
from cbe_bench.place import Place

KEYS = {"episodes", "success", "on_track", "arrived", "median_s", "ci95", "outcomes", "config"}


def test_join_writes_what_was_found(tmp_path, counting) -> None:
    path = tmp_path / "join.json"
    options = ["--length-m", "6", "--episodes", "2", "--jobs", "1", "--world", "val"]
    assert main(["join", *options, "--model", ".", "--json", str(path)]) == 0
    result = json.loads(path.read_text())
    assert result.keys() >= KEYS
    for one in result["runs"]:
        # All segments fit alike, so that the first is taken, at no progress at all.
        assert one["found_s"] > 0.0
        assert one["error_steps"] <= one["at"] + 60


@pytest.mark.parametrize(
    ("error_steps", "outcome", "success"),
    [
        (3.0, Outcome.ARRIVED, True),
        (3.0, Outcome.STUCK, False),
        (80.0, Outcome.ARRIVED, False),
        (None, Outcome.ARRIVED, False),
    ],
)
def test_success_is_being_on_track_and_arriving(error_steps, outcome, success) -> None:
    assert Joined(0, 10, 2.0, error_steps, outcome).success is success


def test_robots_are_set_down_beside_the_drive() -> None:
    place = Place("val", 90_000)
    rng = np.random.default_rng(0)
    world = place.world
    cells = np.argwhere(world.clearance_m > 1.0)[:1, ::-1]
    spot = (cells[0] + 0.5) * world.resolution_m + np.array(world.origin_m)
    drive = np.tile([*spot, 0.3], (100, 1))
    for _ in range(5):
        at, start = join._beside(world, place.batch, drive, rng)
        assert 0 <= at < 100 - join.LEFT_STEPS
        assert math.dist(start[:2], spot) == pytest.approx(OFF_M)
        assert abs(start[2] - 0.3) == pytest.approx(OFF_RAD)


def test_nearest_step_is_sought_where_the_robot_can_be() -> None:
    out = np.stack([np.linspace(0.0, 10.0, 201), np.zeros(201), np.zeros(201)], axis=1)
    there_and_back = np.concatenate([out, out[::-1]])
    poses = np.zeros((20, 3))
    assert join._nearest(there_and_back, poses) == 0
