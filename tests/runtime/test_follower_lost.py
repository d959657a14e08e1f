"""A follower that doubts its place stops, says so, looks for it, and never calls it the end."""

from dataclasses import replace

import numpy as np
import pytest

from cbe.robot import STEP_S, Robot
from cbe_runtime.follower import Follower
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.joining import Whereabouts
from cbe_runtime.networks import Networks
from cbe_runtime.observation import Frame, Observation, Scan
from cbe_runtime.state import Reason, State

ROBOT = Robot()
SURE, DOUBTFUL = 0.995, 0.02
ROUGH = np.random.default_rng(0).integers(-20, 21, (64, 64, 3))  # a blank view is a covered lens
OPEN = np.full(ROBOT.scan_rays, 5.0, np.float32)
CREEP_MPS = FollowerConfig().join.creep_mps


class Drive:
    """Steps a follower through views that differ in nothing but how bright they are."""

    def __init__(self, follower):
        self.follower = follower
        self.steps = 0
        self.grey = 90  # as at the route's end

    def step(self, steps=1):
        for _ in range(steps):
            now_s, stamp_ns = 100.0 + self.steps * STEP_S, 1_000 + self.steps * 100_000_000
            shown = (self.grey + ROUGH).astype(np.uint8)
            shown[0, 0] = self.steps % 200  # a camera never shows the very same
            seen = Observation(Frame(shown, now_s, stamp_ns), Scan(OPEN, now_s, stamp_ns))
            decision = self.follower.step(seen, now_s)
            self.steps += 1
        return decision

    def until(self, state, steps=200):
        for _ in range(steps):
            decision = self.step()
            if decision.state is state:
                return decision
        pytest.fail(f"never {state}, but {decision}")
        raise AssertionError


@pytest.fixture
def says(monkeypatch):
    """Have the generator say this of all segments; may be changed while driving."""
    said = {"on_route": SURE, "progress": 0.4}
    generate = Networks.generate

    def saying(self, *inputs):
        prediction, state = generate(self, *inputs)
        return replace(prediction, **said), state

    monkeypatch.setattr(Networks, "generate", saying)
    return said


@pytest.fixture
def drive(networks, route):
    return Drive(Follower(networks, route))


def test_doubt_stops_the_robot_within_5_s_and_says_what_to_do(drive, says):
    drive.follower.start()
    drive.step(50)
    says["on_route"] = DOUBTFUL
    first = drive.steps
    decision = drive.until(State.LOST)
    assert (drive.steps - first) * STEP_S < 5.0
    assert (decision.speed_mps, decision.yaw_rate_rad_s) == (0.0, 0.0)
    assert decision.lost > 0.9
    assert "start" in drive.follower.advice
    assert drive.step(100).state is State.LOST


def test_no_advice_is_given_while_all_is_well(drive, says):
    drive.follower.start()
    assert drive.step(20).lost < 0.1
    assert drive.follower.advice is None


def test_end_that_looks_unlike_its_attractor_is_no_arrival(networks, route, says):
    elsewhere = (*route.attractors[:-1], route.attractors[0])
    drive = Drive(Follower(networks, replace(route, attractors=elsewhere)))
    drive.follower.start()
    drive.step(4)
    drive.follower._begin(1)
    says["progress"] = 0.99
    assert drive.until(State.LOST).segment == 1


def test_route_without_attractors_arrives_all_the_same(networks, route, says):
    nothing = (bytes(len(route.attractors[0])),) * len(route.attractors)
    drive = Drive(Follower(networks, replace(route, attractors=nothing)))
    drive.follower.start()
    drive.step(4)
    drive.follower._begin(1)
    says["progress"] = 0.99
    drive.until(State.ARRIVED)


def lose(drive, says):
    drive.follower.start()
    drive.step(10)
    says["on_route"] = DOUBTFUL
    drive.until(State.LOST)
    drive.step(20)


def test_lost_robot_that_stands_does_not_try_again(drive, says):
    lose(drive, says)
    says["on_route"] = SURE
    assert {drive.step().state for _ in range(50)} == {State.LOST}


def test_lost_robot_that_is_carried_back_joins_by_itself(networks, route, says):
    config = FollowerConfig()
    config = replace(config, join=replace(config.join, moved=0.001))  # the tiny network sees little
    drive = Drive(Follower(networks, route, config=config))
    lose(drive, says)
    says["on_route"] = SURE
    drive.grey = 200
    drive.until(State.JOINING)
    assert drive.until(State.FOLLOWING).lost < 0.1


def test_robot_creeps_while_it_joins(drive, says):
    says["on_route"] = 0.9
    drive.follower.relocalise()
    assert drive.step().state is State.JOINING
    decisions = [drive.step() for _ in range(12)]
    assert {decision.state for decision in decisions} == {State.JOINING}
    speeds = [decision.speed_mps for decision in decisions]
    assert max(speeds) == pytest.approx(CREEP_MPS, abs=0.01)
    says["on_route"] = SURE
    drive.until(State.FOLLOWING)
    assert drive.step(10).speed_mps > CREEP_MPS


def test_joining_robot_brakes_before_it_looks(drive, says):
    drive.follower.start()
    drive.step(20)
    drive.follower.relocalise()
    decision = drive.step()
    assert (decision.state, decision.speed_mps, decision.ticked) == (State.JOINING, 0.0, False)
    assert not decision.standing


def test_joining_near_a_place_takes_it(drive, says):
    drive.follower.relocalise(Whereabouts(1, 0.5, 0.0))
    assert drive.until(State.FOLLOWING).segment in {0, 1}


def test_robot_that_fits_nowhere_is_lost_even_with_a_hint(drive, says):
    says["on_route"] = DOUBTFUL
    drive.follower.relocalise(Whereabouts(1, 0.5, 0.0))
    decision = drive.until(State.LOST, 20)
    assert decision.place.segment in {0, 1}


def test_start_sends_a_lost_robot_off_from_the_beginning(drive, says):
    lose(drive, says)
    says["on_route"] = SURE
    drive.follower.start()
    decision = drive.step()
    assert (decision.state, decision.segment) == (State.FOLLOWING, 0)
    assert drive.step(30).state is State.FOLLOWING


def test_stop_holds_a_joining_robot_and_start_goes_on_looking(drive, says):
    drive.follower.relocalise()
    drive.step(3)
    drive.follower.stop()
    assert drive.step().reason is Reason.OPERATOR
    drive.follower.start()
    assert drive.step().state is State.JOINING
    drive.until(State.FOLLOWING)
