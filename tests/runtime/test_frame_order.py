"""Frames that are late, lost, repeated, overtaken or dated by a clock that was set."""

import time

import numpy as np
import pytest

from cbe import topics
from cbe.images import raw
from cbe.inbox import Latest
from cbe.rays import scan_message
from cbe.robot import STEP_S, Robot
from cbe_runtime.follower import Follower
from cbe_runtime.observation import CLOCK_SET_NS, Frame, Observation, Scan, newer
from cbe_runtime.sensors import Sensors
from cbe_runtime.state import Reason, State
from cbe_runtime.view import View

STEP_NS = 100_000_000
HOUR_NS = 3_600_000_000_000
OPEN = np.full(Robot().scan_rays, np.inf, np.float32)
IMAGE = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)


class Drive:
    """Feeds a follower frames of given stamps, and fresh scans."""

    def __init__(self, follower):
        self.follower = follower
        self.step_count = 0
        self.frame = None
        follower.start()

    def step(self, stamp_ns=None):
        """One step; a new frame of that stamp has come, or none."""
        now_s = 100.0 + self.step_count * STEP_S
        self.step_count += 1
        if stamp_ns is not None:
            self.frame = Frame(np.roll(IMAGE, self.step_count, axis=1), now_s, stamp_ns)
        scan = Scan(OPEN, now_s, self.step_count)
        return self.follower.step(Observation(self.frame, scan), now_s)

    def steps(self, stamps_ns):
        return [self.step(stamp_ns) for stamp_ns in stamps_ns]


@pytest.fixture
def drive(networks, route):
    drive = Drive(Follower(networks, route))
    drive.steps(HOUR_NS + STEP_NS * np.arange(6))
    return drive


def fed(drive):
    """How many frames the encoder has counted."""
    return int(drive.follower._behavior.sight.state[0])


def test_frame_that_was_overtaken_is_never_fed(drive):
    before = fed(drive)
    decisions = drive.steps([HOUR_NS + 4 * STEP_NS, HOUR_NS + 3 * STEP_NS])
    assert fed(drive) == before
    assert not any(decision.ticked for decision in decisions)
    assert drive.step(HOUR_NS + 8 * STEP_NS).ticked


def test_frame_that_comes_twice_is_fed_once(drive):
    before = fed(drive)
    drive.steps([HOUR_NS + 6 * STEP_NS] * 3)
    assert fed(drive) == before + 1


def test_camera_that_only_falls_behind_is_frozen(drive):
    decision = drive.steps(HOUR_NS + STEP_NS * np.arange(4, 0, -1) + 1)[-1]
    assert (decision.state, decision.reason) == (State.STOPPED, Reason.FROZEN_CAMERA)


def test_gap_tells_the_steps_between_two_frames_that_were_fed(drive):
    decisions = drive.steps([HOUR_NS + 6 * STEP_NS, None, None, HOUR_NS + 9 * STEP_NS])
    assert [decision.gap_steps for decision in decisions] == [2, 0, 0, 3]


def test_lost_frames_slow_the_robot_down_before_they_stop_it(drive):
    drive.steps(HOUR_NS + STEP_NS * np.arange(6, 16))
    speeds = [decision.speed_mps for decision in drive.steps([None] * 4)]
    assert speeds[0] > 0.45
    assert speeds[0] > speeds[1] > speeds[2]
    assert speeds[3] == 0.0


@pytest.mark.parametrize("jump_ns", [-HOUR_NS, HOUR_NS, -2 * CLOCK_SET_NS, -CLOCK_SET_NS // 2])
def test_clock_that_is_set_freezes_nothing_for_long(drive, jump_ns):
    stamps_ns = HOUR_NS + STEP_NS * np.arange(6, 30) + jump_ns
    decisions = drive.steps(stamps_ns)
    assert decisions[-1].state is State.FOLLOWING
    assert any(decision.ticked for decision in decisions[-3:])


def test_single_frame_of_a_far_future_harms_nothing(drive):
    drive.step(9 * HOUR_NS)
    decisions = drive.steps(HOUR_NS + STEP_NS * np.arange(7, 12))
    assert all(decision.state is State.FOLLOWING for decision in decisions)


def test_what_could_not_be_read_is_new_each_time():
    assert newer(-2, -1)
    assert newer(-1, 5)
    assert not newer(-1, -1)


class FakeLink:
    def __init__(self):
        self.inboxes = {}

    def latest(self, topic):
        return self.inboxes.setdefault(topic, Latest(topic.message.from_cdr))

    def send(self, stamp_ns):
        self.inboxes[topics.CAMERA_RAW].store(raw(IMAGE, stamp_ns).to_cdr())
        self.inboxes[topics.SCAN].store(scan_message(OPEN, stamp_ns).to_cdr())


@pytest.mark.parametrize("latency_s", [0.0, 30.0, -30.0])
def test_ages_count_from_stamps_where_clocks_agree(latency_s, caplog):
    link = FakeLink()
    sensors = Sensors(link, View(), Robot(), max_latency_s=10.0)
    link.send(time.time_ns() - round(1e9 * latency_s))
    seen = sensors.observe()
    for sample in (seen.frame, seen.scan):
        age_s = time.monotonic() - sample.received_s
        assert age_s == pytest.approx(abs(latency_s), abs=5.0)
    assert ("--max-latency" in caplog.text) == (latency_s != 0.0)


def test_without_clocks_that_agree_a_latency_is_invisible():
    link = FakeLink()
    sensors = Sensors(link, View(), Robot())
    link.send(time.time_ns() - HOUR_NS)
    assert time.monotonic() - sensors.observe().frame.received_s < 60.0
