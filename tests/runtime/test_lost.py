import pytest

from cbe_runtime.lost import LostBelief, LostConfig

CONFIG = LostConfig()
TICKS_IN_TIME = 25  # 5 s at 5 Hz


def after(said, prior=0.0):
    belief = LostBelief(CONFIG, prior)
    for on_route in said:
        belief.update(on_route)
    return belief


def test_what_right_drives_say_is_never_lost():
    said = [0.99] * 40 + [0.5] * 3  # now and then a doubt, as before turns
    assert not any(after(said[: n + 1] * 10).lost for n in range(len(said)))


@pytest.mark.parametrize("on_route", [0.02, 0.1, 0.4])
def test_doubt_that_lasts_is_lost_within_5_s(on_route):
    belief = after([0.99] * 100)
    ticks = 0
    while not belief.lost:
        belief.update(on_route)
        ticks += 1
    assert 3 < ticks < TICKS_IN_TIME


def test_single_tick_however_bad_is_not_lost():
    assert not after([0.99] * 10 + [0.0]).lost


def test_belief_that_was_sure_for_long_turns_as_fast_as_another():
    long, short = ([0.99] * n + [0.05] * 15 for n in (10_000, 30))
    assert after(long).log_odds == pytest.approx(after(short).log_odds, abs=0.01)


def test_view_that_contradicts_its_place_counts_against_it():
    belief = after([0.99] * 10)
    before = belief.probability
    belief.contradict()
    assert belief.probability > before


@pytest.mark.parametrize("on_route", [0.0, 1.0])
def test_probability_stays_one(on_route):
    assert 0.0 < after([on_route] * 100).probability < 1.0
