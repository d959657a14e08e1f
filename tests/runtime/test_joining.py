"""A robot's place is found among segments that compete; what it costs does not grow with them."""

from dataclasses import replace

import numpy as np
import pytest

from cbe_runtime.joining import JoinConfig, Search, Whereabouts, advice
from cbe_runtime.lost import LostConfig
from cbe_runtime.networks import Networks
from cbe_runtime.route import Segment

CONFIG = JoinConfig()
IMAGE = np.full((64, 64, 3), 90, np.uint8)
OTHER = np.full((64, 64, 3), 200, np.uint8)


def route_of(route, segments):
    """A route whose segments differ in their embeddings: of segment i it is i at first."""
    embedding = route.precision.embedding
    return replace(
        route,
        attractors=(route.attractors[0],) * (segments + 1),
        segments=tuple(
            Segment(embedding.pack(np.full(32, i, np.float32)), 30) for i in range(segments)
        ),
    )


@pytest.fixture
def says(monkeypatch):
    """Have a segment's generator say how likely it is; returns the number of its runs."""
    generate = Networks.generate
    runs = []
    likely = {}

    def fixed(self, *inputs):
        prediction, state = generate(self, *inputs)
        segment = int(state.recalled[0])
        runs.append(segment)
        return replace(prediction, on_route=likely.get(segment, 0.02), progress=0.4), state

    monkeypatch.setattr(Networks, "generate", fixed)
    return likely, runs


def search_of(networks, route, hint=None, config=CONFIG):
    return Search(networks, route, LostConfig(), config, hint)


def look(search, ticks=100, image=IMAGE):
    for tick in range(ticks):
        if search.found or search.failed:
            return tick
        search.look(image)
    return ticks


def test_segment_that_fits_is_found(networks, route, says):
    says[0].update({3: 0.99, 5: 0.7})
    search = search_of(networks, route_of(route, 8))
    look(search)
    assert search.found.behavior.segment == 3
    assert search.place == search.found.place
    assert search.place.progress == pytest.approx(0.4)
    assert search.place.confidence > CONFIG.certain


def test_robot_stands_until_all_segments_were_tried(networks, route, says):
    says[0][0] = 0.99
    search = search_of(networks, route_of(route, 3 * CONFIG.at_once))
    for _ in range(3):
        assert search.standing
        assert search.prediction is None
        search.look(IMAGE)
    assert not search.standing


@pytest.mark.parametrize("segments", [5, 50, 500])
def test_tick_costs_the_same_at_any_length(networks, route, says, segments):
    likely, runs = says
    likely.update(dict.fromkeys(range(segments), 0.9))
    search = search_of(networks, route_of(route, segments))
    for _ in range(20):
        before = len(runs)
        search.look(IMAGE)
        assert len(runs) - before <= CONFIG.at_once


def test_nothing_that_fits_fails_at_once(networks, route, says):
    search = search_of(networks, route_of(route, 4))
    assert look(search) == 1
    assert search.failed
    assert search.found is None


def test_hypothesis_that_is_refuted_on_the_way_is_dropped(networks, route, says):
    likely, _ = says
    likely.update({1: 0.99, 2: 0.95})
    search = search_of(networks, route_of(route, 4))
    look(search, 3)
    likely[1] = 0.01
    look(search)
    assert search.found.behavior.segment == 2


def test_doubt_that_does_not_end_fails(networks, route, says):
    says[0][1] = 0.8
    search = search_of(networks, route_of(route, 4))
    assert look(search, 1_000) <= CONFIG.most_ticks + 1
    assert search.failed


def test_segments_that_fit_alike_compete_for_longer(networks, route, says):
    likely, _ = says
    likely.update({1: 0.99, 2: 0.99})
    search = search_of(networks, route_of(route, 4))
    assert look(search, CONFIG.least_ticks + 5) == CONFIG.least_ticks + 5
    likely[1] = 0.9
    assert look(search) < CONFIG.decided_ticks
    assert search.found.behavior.segment == 2


def test_hint_limits_the_search_to_its_neighbours(networks, route, says):
    likely, runs = says
    likely.update({1: 0.99, 6: 0.98})
    search = search_of(networks, route_of(route, 9), Whereabouts(6, 0.5, 0.0))
    look(search)
    assert search.found.behavior.segment == 6
    assert set(runs) == {5, 6, 7}


def test_moved_robot_is_told_from_one_that_stands(networks, route, says):
    # The tiny network sees little of a picture.
    search = search_of(networks, route_of(route, 4), config=JoinConfig(moved=0.001))
    look(search)
    assert not search.elsewhere(IMAGE)
    assert search.elsewhere(OTHER)


def test_search_that_was_given_up_waits_for_another_view_than_the_next(networks, route):
    search = search_of(networks, route_of(route, 4), config=JoinConfig(moved=0.001))
    search.give_up()
    assert search.failed
    assert not search.elsewhere(IMAGE)  # where the robot stands
    assert not search.elsewhere(IMAGE)
    assert search.elsewhere(OTHER)


def test_share_of_the_route_counts_steps(route):
    uneven = replace(route, segments=tuple(replace(s, steps=n) for s, n in zip(
        route.segments, (10, 30), strict=True)))  # fmt: skip
    assert Whereabouts(1, 0.5, 1.0).share_of(uneven) == pytest.approx(25 / 40)
    assert Whereabouts(1, 1.7, 1.0).share_of(uneven) == 1.0


def test_advice_names_the_likeliest_place(route):
    assert "segment 2 of 2, 75 % of the way" in advice(Whereabouts(1, 0.5, 0.4), route)
    assert "start" in advice(None, route)


def test_hypothesis_that_is_merely_unsure_midway_is_followed_on(networks, route, says):
    likely, _ = says
    likely[3] = 0.8
    search = search_of(networks, route_of(route, 5))
    look(search, 2)
    likely[3] = 0.55  # the belief to drive on calls this lost
    look(search, 20)
    assert not search.failed
    assert search.found is None
    assert search.place.segment == 3
    likely[3] = 0.99
    look(search, 30)
    assert search.found.behavior.segment == 3


def test_hypothesis_that_is_refuted_is_given_up(networks, route, says):
    likely, _ = says
    likely[3] = 0.8
    search = search_of(networks, route_of(route, 5))
    look(search, 2)
    likely[3] = 0.05
    look(search)
    assert search.failed
