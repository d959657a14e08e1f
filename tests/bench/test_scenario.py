"""Episodes are drawn from their seeds alone, and fit the world they take place in."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cbe.errors import ConfigError, WorldError
from cbe.robot import Robot
from cbe_bench import scenario as scenario_module
from cbe_bench.drives import Pieces
from cbe_bench.place import Place, world_seeds
from cbe_bench.scenario import Terms, scenarios
from cbe_hil_sim.generate import TEST_SEEDS

STEPS = 30
TERMS = Terms(world="test", drives=Pieces(STEPS), seed=3)
GROUP = 3


@pytest.fixture(scope="module", autouse=True)
def small_groups():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenario_module, "GROUP", GROUP)
        yield


@pytest.fixture(scope="module")
def open_place(small_groups):
    opened: dict[int, Place] = {}

    def open_(seed):
        if seed not in opened:
            opened[seed] = Place("test", seed)
        return opened[seed]

    return open_


@pytest.fixture(scope="module")
def group(open_place):
    return scenarios(TERMS, 0, GROUP, TEST_SEEDS, open_place)


@pytest.fixture(scope="module")
def with_bins(open_place):
    terms = replace(TERMS, obstacles=1, obstacle_offset_m=0.15)
    return scenarios(terms, 0, GROUP, TEST_SEEDS, open_place)


def test_same_seeds_give_the_same_episodes_however_many_are_asked_for(group, open_place) -> None:
    again = scenarios(TERMS, 0, 2, TEST_SEEDS, open_place)
    assert [s.index for _, s in again] == [0, 1]
    for (_, first), (_, second) in zip(group, again, strict=False):
        assert first.world_seed == second.world_seed
        np.testing.assert_array_equal(first.demonstration, second.demonstration)
        np.testing.assert_array_equal(first.start, second.start)


def test_another_seed_gives_other_episodes(group, open_place) -> None:
    _, other = scenarios(replace(TERMS, seed=4), 0, 1, TEST_SEEDS, open_place)[0]
    assert not np.array_equal(other.demonstration[-1], group[0][1].demonstration[-1])


def test_demonstration_has_the_length_asked_for(group) -> None:
    assert len(group) == GROUP
    for _, scenario in group:
        assert scenario.demonstration.shape == (STEPS + 1, 3)
        assert scenario.length_m <= STEPS * 0.05 + 1e-6


def test_starts_are_jittered_within_limits_and_free(group) -> None:
    for place, scenario in group:
        moved = np.hypot(*(scenario.start - scenario.demonstration[0])[:2])
        assert 0.0 < moved <= 1.0
        assert place.world.clearance_at(scenario.start[:2]) > Robot().body_radius_m


def test_no_jitter_starts_where_the_demonstration_does(open_place) -> None:
    terms = replace(TERMS, jitter_scale=0.0)
    _, scenario = scenarios(terms, 0, 1, TEST_SEEDS, open_place)[0]
    np.testing.assert_array_equal(scenario.start, scenario.demonstration[0])


def test_jitter_scale_keeps_the_drive(group, open_place) -> None:
    _, scenario = scenarios(replace(TERMS, jitter_scale=0.4), 0, 1, TEST_SEEDS, open_place)[0]
    np.testing.assert_array_equal(scenario.demonstration, group[0][1].demonstration)


def test_bin_stands_at_its_offset_away_from_both_ends(with_bins) -> None:
    for _, scenario in with_bins:
        (bin_,) = scenario.bins
        centre = (bin_.x_m, bin_.y_m)
        distance = np.hypot(*(scenario.demonstration[:, :2] - centre).T)
        assert distance.min() <= 0.15 + 1e-9
        assert math.isclose(distance[10:-10].min(), distance.min())


def test_bin_leaves_a_way_and_is_not_met_at_the_start(with_bins) -> None:
    for place, scenario in with_bins:
        (bin_,) = scenario.bins
        standing = bin_.in_world(place.world)
        assert standing.blocked.sum() > place.world.blocked.sum()
        assert standing.clearance_at(scenario.start[:2]) > Robot().body_radius_m


def test_several_bins_stand_apart_and_the_first_where_it_stood_alone(with_bins, open_place) -> None:
    terms = replace(TERMS, drives=Pieces(120), obstacles=1)
    _, one = scenarios(terms, 0, 1, TEST_SEEDS, open_place)[0]
    _, two = scenarios(replace(terms, obstacles=2), 0, 1, TEST_SEEDS, open_place)[0]
    first, second = two.bins
    assert math.dist((first.x_m, first.y_m), (second.x_m, second.y_m)) >= 1.5
    assert one.bins == (first,)


def test_world_without_room_is_an_error_that_says_so(open_place) -> None:
    plain = open_place(TEST_SEEDS[0])
    full = replace(plain.world, solid_top_m=np.full_like(plain.world.solid_top_m, 2.0))

    class Full:
        world, batch = full, plain.batch

    with pytest.raises(WorldError, match="no drive of 30 steps"):
        scenarios(TERMS, 0, 1, [TEST_SEEDS[0]], lambda seed: Full())


@pytest.mark.parametrize(
    ("world", "chosen"),
    [("test", range(5)), ("val", range(109_999, 110_001)), ("nowhere.yaml", None)],
)
def test_worlds_outside_the_split_are_refused(world, chosen) -> None:
    with pytest.raises(ConfigError):
        world_seeds(world, chosen)
