import math
from dataclasses import replace

import numpy as np
import pytest

from cbe.errors import ModelError, RouteError
from cbe.robot import STEP_S, Robot
from cbe.signature import OVERRUN_M
from cbe_runtime.behavior import Behavior
from cbe_runtime.berth import BerthConfig
from cbe_runtime.follower import Follower
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.networks import Networks
from cbe_runtime.observation import Frame, Observation, Scan
from cbe_runtime.state import Reason, State

ROBOT = Robot()
IMAGE = (85 + np.arange(64 * 64 * 3) % 11).astype(np.uint8).reshape(64, 64, 3)  # grey, grainy
OPEN = np.full(ROBOT.scan_rays, np.inf, np.float32)


class Drive:
    """Feeds a follower fresh samples on a clock of its own."""

    def __init__(self, follower):
        self.follower = follower
        self.steps = 0
        follower.start()

    @property
    def now_s(self):
        return 100.0 + self.steps * STEP_S

    @property
    def stamp_ns(self):
        return 1_000 + self.steps * 100_000_000

    def frame(self, image=IMAGE):
        return Frame(image, self.now_s, self.stamp_ns)

    def scan(self, ranges_m=OPEN):
        return Scan(ranges_m, self.now_s, self.stamp_ns)

    def step(self, steps=1, **changed):
        for _ in range(steps):
            frame = self.frame(np.roll(IMAGE, self.steps, axis=1))  # no camera's stands still
            seen = Observation(**({"frame": frame, "scan": self.scan()} | changed))
            decision = self.follower.step(seen, self.now_s)
            self.steps += 1
        return decision


@pytest.fixture
def drive(networks, route):
    return Drive(Follower(networks, route))


def test_idle_until_started(networks, route):
    drive = Drive(follower := Follower(networks, route))
    follower._asking.clear()
    decision = drive.step()
    assert (decision.state, decision.speed_mps, decision.ticked) == (State.IDLE, 0.0, False)


def test_started_follower_drives_to_its_waypoint(drive):
    decision = drive.step(10)
    assert decision.state is State.FOLLOWING
    assert decision.reason is None
    assert decision.speed_mps > 0.3
    assert decision.yaw_rate_rad_s == pytest.approx(0.0, abs=0.05)
    assert decision.waypoint_m is not None


def test_networks_run_every_network_period(drive):
    assert [drive.step().ticked for _ in range(6)] == [True, False] * 3


def test_waypoint_held_between_ticks_comes_nearer_by_the_travel(drive):
    drive.step(10)
    ticked = drive.step()
    held = drive.step()
    assert (ticked.ticked, held.ticked) == (True, False)
    travel_m = ticked.speed_mps * STEP_S
    assert held.waypoint_m[0] == pytest.approx(ticked.waypoint_m[0] - travel_m, abs=1e-3)


def test_waypoint_to_the_left_turns_left(tmp_path, model_writer, route):
    networks = Networks.load(model_writer(tmp_path, waypoint_m=(0.4, 0.2)))
    assert Drive(Follower(networks, route)).step(6).yaw_rate_rad_s > 0.2


def test_segment_switches_at_its_progress_and_resets_every_state(drive):
    # Ticks 19 and 20 lie above 0.95, and two in a row must agree: the 20th tick switches.
    decision = drive.step(39)
    assert (decision.segment, decision.progress) == (1, 0.0)
    decision = drive.step(2)
    assert decision.ticked
    assert decision.progress == pytest.approx(1 / 19.5)
    assert drive.follower._behavior.sight.state[0] == 1


def test_single_tick_of_high_progress_does_not_switch(drive, monkeypatch):
    drive.step(4)
    generate = Networks.generate

    def spike(self, *inputs):
        prediction, state = generate(self, *inputs)
        return replace(prediction, progress=1.0), state

    with monkeypatch.context() as patch:
        patch.setattr(Networks, "generate", spike)
        assert drive.step().ticked
    assert drive.step(4).segment == 0


def _saying(drive, monkeypatch, segment=1, **said):
    """Have the generator say this from now on; the route's last segment is 1.

    Where only the end is said, the waypoint lies beyond it. What is said can be changed later.
    """
    if "end" in said:
        x, y, cos, sin = said["end"]
        said.setdefault("waypoint_m", np.array([x + OVERRUN_M * cos, y + OVERRUN_M * sin]))
    drive.step()
    drive.follower._begin(segment)
    generate = Networks.generate

    def fixed(self, *inputs):
        prediction, state = generate(self, *inputs)
        return replace(prediction, **said), state

    monkeypatch.setattr(Networks, "generate", fixed)
    return said


@pytest.mark.parametrize(
    ("progress", "waypoint_x_m", "state"),
    [
        (0.9, OVERRUN_M + 0.03, State.ARRIVED),
        (0.9, OVERRUN_M + 0.2, State.FOLLOWING),  # not there yet
        (0.7, OVERRUN_M + 0.03, State.FOLLOWING),  # a waypoint this near may also mean doubt
    ],
)
def test_stalled_progress_arrives_only_where_the_waypoint_says_rest(
    drive, monkeypatch, progress, waypoint_x_m, state
):
    end = np.array([waypoint_x_m - OVERRUN_M, 0.0, 1.0, 0.0])
    _saying(drive, monkeypatch, progress=progress, end=end)
    assert drive.step(40).state is state


@pytest.mark.parametrize(
    ("progress", "end_x_m", "unlike", "ahead_m", "parks"),
    [
        (0.9, 0.4, 0.2, 0.8, True),
        (0.7, 0.4, 0.2, 0.8, False),
        (0.9, 0.8, 0.2, 0.8, False),
        (0.9, 0.4, 0.3, 0.8, False),
        (0.9, 0.4, 0.2, 3.0, False),
    ],
)
def test_parks_early_only_where_the_end_is_in_sight_before_a_wall(
    drive, monkeypatch, progress, end_x_m, unlike, ahead_m, parks
):
    _saying(drive, monkeypatch, progress=progress, end=np.array([end_x_m, 0.0, 1.0, 0.0]))
    monkeypatch.setattr(Behavior, "unlike_goal", unlike)
    for _ in range(6):
        drive.step(scan=drive.scan(np.full_like(OPEN, ahead_m)))
    assert drive.follower._berth.taken is parks


def test_stalled_progress_switches_where_the_waypoint_says_rest(drive, monkeypatch):
    _saying(drive, monkeypatch, segment=0, progress=0.9, waypoint_m=np.array([0.05, 0.0]))
    assert drive.step(6).segment == 1


NEAR_END = np.array([0.2, 0.0, 1.0, 0.0])
STEADFAST = FollowerConfig(berth=BerthConfig(trust=0.0))
"""Parks where it first saw the end: a fixed one moves on with the robot."""


def _parks(drive):
    """Step until the robot is on its way to its berth."""
    for _ in range(2 * 40):
        decision = drive.step()
        if drive.follower._berth.taken:
            return decision
    pytest.fail("never arrived")


def _is_lost_and_never_arrives(drive):
    states = [drive.step().state for _ in range(40)]
    assert State.LOST in states
    assert State.ARRIVED not in states


def test_arrives_once_it_stands_where_it_sees_the_end(networks, route, monkeypatch):
    drive = Drive(Follower(networks, route, config=STEADFAST))
    _saying(drive, monkeypatch, progress=1.0, end=NEAR_END)
    decision = _parks(drive)
    assert decision.segment == 1
    speeds = [decision.speed_mps]
    x_m, goal_m = 0.0, drive.follower._berth.place_m[0]
    assert goal_m > 0.1
    while decision.state is not State.ARRIVED:
        assert decision.state is State.FOLLOWING
        x_m += decision.speed_mps * STEP_S
        decision = drive.step()
        speeds.append(decision.speed_mps)
        assert len(speeds) < 60
    assert decision.standing
    assert (np.diff(speeds) <= 1e-9).all()
    assert x_m == pytest.approx(goal_m, abs=0.08)  # creeping for two looks
    assert drive.step(5).speed_mps == 0.0


def test_end_seen_to_one_side_is_turned_to_though_the_waypoint_is_straight_ahead(
    drive, monkeypatch
):
    end = np.array([0.3, 0.1, np.cos(0.4), np.sin(0.4)])
    _saying(drive, monkeypatch, progress=1.0, end=end, waypoint_m=np.array([0.6, 0.0]))
    _parks(drive)
    assert drive.step().yaw_rate_rad_s > 0.5


def test_robot_that_stands_where_nothing_looks_like_the_end_is_lost(drive, monkeypatch):
    _parks(drive)
    monkeypatch.setattr(Behavior, "unlike_goal", 0.32)
    drive.follower._berth.lowest = 0.32
    _is_lost_and_never_arrives(drive)


def test_robot_that_stands_hardly_sure_to_be_on_the_route_is_lost(drive, monkeypatch):
    _saying(drive, monkeypatch, progress=1.0, on_route=0.9, end=NEAR_END)
    _parks(drive)
    _is_lost_and_never_arrives(drive)


def test_one_view_unsure_of_the_route_while_parking_is_enough_to_be_lost(drive, monkeypatch):
    with monkeypatch.context() as patch:
        _saying(drive, patch, progress=1.0, on_route=0.9, end=NEAR_END)
        _parks(drive)
    _is_lost_and_never_arrives(drive)


@pytest.mark.parametrize(("apart_m", "state"), [(0.25, State.ARRIVED), (0.35, State.LOST)])
def test_robot_that_stands_where_two_readings_of_the_end_disagree_is_lost(
    drive, monkeypatch, apart_m, state
):
    end, waypoint_m = np.array([0.0, 0.0, 1.0, 0.0]), np.array([OVERRUN_M, apart_m])
    _saying(drive, monkeypatch, progress=1.0, end=end, waypoint_m=waypoint_m)
    _parks(drive)
    while (decision := drive.step()).state is State.FOLLOWING:
        pass
    assert decision.state is state
    later = drive.step(100)
    assert (later.state, later.speed_mps) == (state, 0.0)  # nor does it drive on to look again


@pytest.mark.parametrize(("before_m", "state"), [(0.9, State.ARRIVED), (0.25, State.LOST)])
def test_robot_is_lost_where_the_end_comes_no_nearer_however_far_it_drives(
    networks, route, monkeypatch, before_m, state
):
    drive = Drive(Follower(networks, route, config=STEADFAST))
    said = _saying(drive, monkeypatch, progress=0.5, end=np.array([before_m, 0.0, 1.0, 0.0]))
    drive.step(40)
    said["progress"], said["end"] = 1.0, NEAR_END
    said["waypoint_m"] = np.array([NEAR_END[0] + OVERRUN_M, 0.0])
    assert drive.step(40).state is state


@pytest.mark.parametrize(("share", "state"), [(1.0, State.ARRIVED), (0.5, State.LOST)])
def test_narrower_camera_must_see_its_end_more_alike(drive, monkeypatch, share, state):
    _parks(drive)
    monkeypatch.setattr(Behavior, "unlike_goal", 0.2)
    monkeypatch.setattr("cbe_runtime.follower.visible", lambda image: share)
    drive.follower._berth.lowest = 0.2
    while (decision := drive.step()).state is State.FOLLOWING:
        pass
    assert decision.state is state


def test_robot_held_up_on_its_last_metre_goes_on(networks, route, monkeypatch):
    drive = Drive(Follower(networks, route, config=STEADFAST))
    _saying(drive, monkeypatch, progress=1.0, end=np.array([0.3, 0.0, 1.0, 0.0]))
    _parks(drive)
    for range_m, state in ((0.1, State.FOLLOWING), (5.0, State.ARRIVED)):
        for _ in range(40):
            decision = drive.step(scan=drive.scan(np.full_like(OPEN, range_m)))
        assert (decision.state, decision.speed_mps) == (state, 0.0)


def test_end_seen_too_far_away_is_no_arrival(drive, monkeypatch):
    _saying(drive, monkeypatch, progress=1.0, end=np.array([2.0, 0.0, 1.0, 0.0]))
    states = {drive.step().state for _ in range(40)}
    assert State.LOST in states
    assert State.ARRIVED not in states


def test_memory_without_attractors_rests_before_the_last_waypoint(drive, monkeypatch):
    monkeypatch.setattr(Behavior, "pinned", False)
    end, waypoint_m = np.array([2.0, 0.0, 1.0, 0.0]), np.array([0.5, 0.0])
    _saying(drive, monkeypatch, progress=1.0, end=end, waypoint_m=waypoint_m)
    assert drive.step(20).state is State.ARRIVED


def test_start_after_arrival_begins_anew(drive):
    drive.step(150)
    assert drive.follower.state is State.ARRIVED
    drive.follower.start()
    decision = drive.step()
    assert (decision.state, decision.segment) == (State.FOLLOWING, 0)
    assert decision.progress == pytest.approx(1 / 19.5)


@pytest.mark.parametrize(
    ("lost", "reason"), [("frame", Reason.STALE_CAMERA), ("scan", Reason.STALE_SCAN)]
)
def test_sensor_that_falls_silent_stops_the_robot_and_its_return_resumes(drive, lost, reason):
    drive.step(10)
    last = getattr(drive, lost)()
    states = [drive.step(**{lost: last}) for _ in range(6)]
    # Ages 0.0 to 0.3 s are fresh, older is stale.
    assert [decision.state is State.STOPPED for decision in states] == [False] * 4 + [True] * 2
    assert states[-1].reason is reason
    assert (states[-1].speed_mps, states[-1].yaw_rate_rad_s) == (0.0, 0.0)
    assert drive.step().state is State.FOLLOWING


@pytest.mark.parametrize(
    ("frozen", "reason"), [("frame", Reason.FROZEN_CAMERA), ("scan", Reason.FROZEN_SCAN)]
)
def test_sensor_that_repeats_its_stamp_stops_the_robot(drive, frozen, reason):
    drive.step(10)
    stamp_ns = drive.stamp_ns
    for _ in range(5):
        decision = drive.step(**{frozen: replace(getattr(drive, frozen)(), stamp_ns=stamp_ns)})
    assert (decision.state, decision.reason, decision.speed_mps) == (State.STOPPED, reason, 0.0)


def test_frame_delivered_twice_is_encoded_once(drive):
    drive.step(2)
    stamp_ns = drive.stamp_ns
    same = [drive.step(frame=replace(drive.frame(), stamp_ns=stamp_ns)).ticked for _ in range(4)]
    assert same == [True, False, False, False]
    assert drive.step().ticked


@pytest.mark.parametrize(
    ("samples", "reason"),
    [
        ({"frame": None}, Reason.STALE_CAMERA),
        ({"scan": None}, Reason.STALE_SCAN),
    ],
)
def test_sensor_never_received_stops_the_robot(drive, samples, reason):
    decision = drive.step(**samples)
    assert (decision.state, decision.reason) == (State.STOPPED, reason)
    assert math.inf in (decision.camera_age_s, decision.scan_age_s)
    assert drive.step().state is State.FOLLOWING


@pytest.mark.parametrize("image", [None, IMAGE[:32], IMAGE.astype(np.float32), IMAGE[..., :1]])
def test_unusable_image_stops_the_robot(drive, image):
    drive.step(5)
    decision = drive.step(frame=drive.frame(image))
    assert (decision.state, decision.reason) == (State.STOPPED, Reason.BAD_IMAGE)
    assert decision.speed_mps == 0.0


@pytest.mark.parametrize(
    "ranges_m", [None, OPEN * np.nan, OPEN[:100], np.zeros(0), -OPEN, np.full(240, -1.0)]
)
def test_unusable_scan_stops_the_robot(drive, ranges_m):
    drive.step(5)
    decision = drive.step(scan=drive.scan(ranges_m))
    assert (decision.state, decision.reason) == (State.STOPPED, Reason.BAD_SCAN)
    assert decision.speed_mps == 0.0


def test_few_invalid_rays_do_not_stop_the_robot(drive):
    ranges_m = OPEN.copy()
    ranges_m[::10] = np.nan
    assert drive.step(scan=drive.scan(ranges_m)).state is State.FOLLOWING


def test_wall_ahead_keeps_the_robot_from_driving(drive):
    near = np.full(ROBOT.scan_rays, 0.15, np.float32)
    for _ in range(10):
        decision = drive.step(scan=drive.scan(near))
        assert decision.speed_mps == pytest.approx(0.0, abs=1e-6)
    assert decision.state is State.FOLLOWING


def test_model_fault_stops_until_the_next_start(drive, monkeypatch):
    drive.step(4)

    def broken(*_inputs):
        raise ModelError("not finite")

    with monkeypatch.context() as patch:
        patch.setattr(Networks, "generate", broken)
        decision = drive.step()
    assert (decision.state, decision.reason) == (State.STOPPED, Reason.MODEL_FAULT)
    assert decision.speed_mps == 0.0
    assert drive.step(3).state is State.STOPPED
    drive.follower.start()
    assert drive.step().state is State.FOLLOWING


def test_segment_that_takes_too_long_times_out(networks, route):
    config = FollowerConfig(switch_progress=9.0, timeout_factor=1.0, timeout_steps=10)
    drive = Drive(Follower(networks, route, config=config))
    assert drive.step(40).state is State.FOLLOWING
    decision = drive.step()
    assert (decision.state, decision.reason) == (State.STOPPED, Reason.TIMEOUT)
    assert decision.speed_mps == 0.0


def test_operator_stop_holds_and_start_goes_on_in_the_same_segment(drive):
    drive.step(45)
    drive.follower.stop()
    decision = drive.step()
    assert (decision.state, decision.reason) == (State.STOPPED, Reason.OPERATOR)
    assert (decision.speed_mps, decision.segment) == (0.0, 1)
    assert drive.step(3).state is State.STOPPED
    drive.follower.start()
    decision = drive.step()
    assert (decision.state, decision.segment) == (State.FOLLOWING, 1)


def test_stop_wins_over_start_in_one_step(drive):
    drive.step(3)
    drive.follower.start()
    drive.follower.stop()
    assert drive.step().reason is Reason.OPERATOR


def test_resumed_robot_accelerates_from_rest(drive):
    drive.step(10)
    drive.step(5, scan=None)
    assert drive.step().speed_mps <= ROBOT.max_acceleration_mps2 * STEP_S + 1e-9


def test_route_of_another_model_is_refused(tmp_path, model_writer, route):
    other = Networks.load(model_writer(tmp_path, **{"cbe.model_id": "ffffffffffffffff"}))
    with pytest.raises(RouteError, match="re-teach"):
        Follower(other, route)


def test_same_samples_give_the_same_decisions(networks, route):
    one, two = (Drive(Follower(networks, route)) for _ in range(2))
    assert [one.step() for _ in range(90)] == [two.step() for _ in range(90)]
