import json
import threading
from dataclasses import replace

import numpy as np
import pytest

import cbe_runtime.loop
import cbe_runtime.pace
from cbe import topics
from cbe.camera import MODEL_CAMERA
from cbe.errors import LinkError
from cbe.images import compress, raw
from cbe.inbox import Latest
from cbe.messages import CameraInfo
from cbe.rays import scan_message
from cbe.robot import Robot
from cbe_runtime.follower import Follower
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.loop import EXIT_STOPPED, Loop, LoopConfig
from cbe_runtime.observation import Observation
from cbe_runtime.pace import WINDOW_S, LockStep, Ratekeeper
from cbe_runtime.sensors import Sensors
from cbe_runtime.view import View
from cbe_runtime.watchdog import EXIT_HUNG

ROBOT = Robot()
OPEN = np.full(ROBOT.scan_rays, np.inf)


class Outbox:
    def __init__(self):
        self.sent = []
        self.broken = False

    def put(self, message):
        if self.broken:
            raise LinkError("closed")
        self.sent.append(message)


class FakeLink:
    """The link's interface, in memory."""

    def __init__(self):
        self.inboxes = {}
        self.outboxes = {}
        self.calls = {}
        self.alive = []

    def latest(self, topic):
        return self.inboxes.setdefault(topic, Latest(topic.message.from_cdr))

    def publisher(self, topic):
        return self.outboxes.setdefault(topic, Outbox())

    def json_publisher(self, name):
        return self.outboxes.setdefault(name, Outbox())

    def serve(self, name, handler):
        self.calls[name] = handler

    def declare_alive(self, process):
        self.alive.append(process)

    def send(self, topic, message):
        self.inboxes[topic].store(message.to_cdr())

    def send_step(self, step):
        stamp_ns = 1 + step * 100_000_000
        image = picture(step)
        self.send(topics.SCAN, scan_message(OPEN, stamp_ns))
        self.send(topics.CAMERA_RAW, raw(image, stamp_ns))
        return stamp_ns


def picture(step):
    """Grey and grainy (64, 64, 3), another one each step."""
    return (85 + (np.arange(64 * 64 * 3) + step) % 11).astype(np.uint8).reshape(64, 64, 3)


class Clock:
    def __init__(self):
        self.now_s = 50.0
        self.slept = []

    def __call__(self):
        return self.now_s

    def wait(self, timeout_s):
        self.slept.append(timeout_s)
        self.now_s += timeout_s


@pytest.fixture
def link():
    return FakeLink()


@pytest.fixture
def sensors(link):
    return Sensors(link, View(), ROBOT)


@pytest.fixture
def build(link, sensors, networks, route, monkeypatch):
    monkeypatch.setattr(cbe_runtime.loop, "OLD_DECISION_S", 600.0)

    def make(exiting=None, **config):
        # Nothing here is about freshness: a test that is held up for long must not stop the robot.
        follower = Follower(networks, route, config=FollowerConfig(fresh_s=60.0))
        loop = Loop(link, follower, sensors, LoopConfig(**config), exiting or threading.Event())
        return loop, follower

    return make


def tick(loop):
    observation = loop._receive()
    decision = loop._step(observation)
    loop._publish(observation, decision)
    return decision


def drive(loop, follower, link, steps=5):
    follower.start()
    for step in range(steps):
        link.send_step(step)
        decision = tick(loop)
    return decision


def test_command_follows_the_decision(build, link):
    loop, follower = build()
    decision = drive(loop, follower, link)
    command = link.outboxes[topics.CMD_VEL].sent[-1]
    assert decision.speed_mps > 0
    assert command.twist.speed_mps == decision.speed_mps
    assert command.twist.yaw_rate_rad_s == decision.yaw_rate_rad_s
    assert command.frame_id == "base_link"


def test_command_is_unstamped_on_request(build, link):
    loop, follower = build(unstamped=True)
    drive(loop, follower, link)
    assert link.outboxes[topics.CMD_VEL_UNSTAMPED].sent[-1].speed_mps > 0
    assert topics.CMD_VEL not in link.outboxes


def test_idle_follower_leaves_cmd_vel_to_others(build, link):
    loop, _ = build()
    link.send_step(0)
    tick(loop)
    assert link.outboxes[topics.CMD_VEL].sent == []
    assert link.outboxes["status"].sent[-1]["state"] == "IDLE"


def test_status_is_json_and_complete(build, link):
    loop, follower = build()
    follower.start()
    tick(loop)  # before anything was received
    drive(loop, follower, link)
    first, *_, last = link.outboxes["status"].sent
    assert (first["state"], first["reason"]) == ("STOPPED", "STALE_CAMERA")
    assert first["camera_age_s"] is None
    assert last["state"] == "FOLLOWING"
    assert last["segments"] == 2
    assert last["tick_ms"]["p99"] >= last["tick_ms"]["p50"] > 0
    assert last["camera_to_command_ms"]["p50"] > 0
    assert last["inference_ms"]["max"] > 0
    assert sum(last["histograms"]["tick"]) == 6
    assert sum(last["histograms"]["camera_age"]) == 5
    assert last["hangs"] == 0
    assert last["drops"]["camera"]["received"] == 5
    json.dumps([first, last], allow_nan=False)


def test_rpcs_start_stop_and_tell(build, link):
    loop, _ = build()
    link.calls["start"]({})
    link.send_step(0)
    tick(loop)
    assert link.calls["status"]({})["state"] == "FOLLOWING"
    link.calls["stop"]({})
    link.send_step(1)
    tick(loop)
    assert link.calls["status"]({})["reason"] == "OPERATOR"
    assert link.alive == ["runtime"]


class Crash(Exception):
    pass


def test_crash_sends_a_stop_and_is_not_swallowed(build, link, monkeypatch):
    loop, follower = build()
    drive(loop, follower, link)

    def crash(*_):
        raise Crash

    monkeypatch.setattr(follower, "step", crash)
    with pytest.raises(Crash):
        loop.run()
    assert link.outboxes[topics.CMD_VEL].sent[-1].twist.speed_mps == 0.0


def test_decision_that_took_too_long_is_not_obeyed(build, link, monkeypatch):
    loop, follower = build()
    monkeypatch.setattr(cbe_runtime.loop, "OLD_DECISION_S", 0.0)
    assert drive(loop, follower, link).speed_mps > 0.0
    assert {sent.twist.speed_mps for sent in link.outboxes[topics.CMD_VEL].sent} == {0.0}


def test_hung_networks_stop_the_robot_and_then_end_the_process(build, link, monkeypatch):
    ends = []
    loop, follower = build()
    drive(loop, follower, link)
    commands, statuses = link.outboxes[topics.CMD_VEL].sent, link.outboxes["status"].sent
    assert commands[-1].twist.speed_mps > 0.0
    monkeypatch.setattr(loop._watchdog, "_end", ends.append)
    with loop._watchdog:  # and this thread, the loop's, ticks no more
        wait_until(lambda: commands[-1].twist.speed_mps == 0.0)
        wait_until(lambda: statuses[-1]["reason"] == "HUNG")
        assert (statuses[-1]["state"], statuses[-1]["hangs"]) == ("STOPPED", 1)
        wait_until(lambda: ends)
    assert set(ends) == {EXIT_HUNG}


def test_lost_link_ends_the_loop_with_its_error(build, link):
    loop, follower = build()
    drive(loop, follower, link)
    link.outboxes[topics.CMD_VEL].broken = True
    with pytest.raises(LinkError):
        loop.run()


def test_exit_sends_a_stop(build, link):
    exiting = threading.Event()
    loop, follower = build(exiting)
    drive(loop, follower, link)
    exiting.set()
    assert loop.run() == 0
    assert link.outboxes[topics.CMD_VEL].sent[-1].twist.speed_mps == 0.0
    assert link.outboxes["status"].sent[-1]["state"] == "EXITED"


def test_loop_exits_with_zero_once_arrived_and_standing(build, link):
    exiting = threading.Event()
    loop, follower = build(exiting, exit_when_done=True)
    follower.start()
    step = 0
    while not exiting.is_set():
        link.send_step(step)
        decision = tick(loop)
        step += 1
        assert step < 300, decision
    assert (decision.state, decision.standing) == ("ARRIVED", True)
    assert loop.run() == 0


def test_loop_exits_with_an_error_once_stopped_for_too_long(build, link):
    exiting = threading.Event()
    loop, follower = build(exiting, exit_when_done=True, patience_s=0.0)
    follower.start()
    tick(loop)
    tick(loop)
    assert exiting.is_set()
    assert loop.run() == EXIT_STOPPED


def test_lockstep_answers_each_frame_under_its_own_stamp(build, link):
    exiting = threading.Event()
    loop, follower = build(exiting, lockstep=True, lockstep_patience_s=600.0)
    follower.start()
    thread = threading.Thread(target=loop.run)
    thread.start()
    answered = link.outboxes[topics.CMD_VEL].sent
    try:
        for step in range(20):
            stamp_ns = link.send_step(step)
            wait_until(lambda stamp_ns=stamp_ns: answered and answered[-1].stamp_ns == stamp_ns)
        before = len(answered)
        link.send_step(19)  # the answer got lost
        wait_until(lambda: len(answered) > before)
        assert answered[-1] == answered[before - 1]
    finally:
        exiting.set()
        thread.join(60)
    assert answered[-2].stamp_ns == stamp_ns
    assert link.outboxes["status"].sent[-1]["state"] == "EXITED"


def test_lockstep_waits_for_the_scan_of_its_frame(link, sensors, monkeypatch):
    monkeypatch.setattr(cbe_runtime.pace, "SCAN_PATIENCE_S", 600.0)
    exiting = threading.Event()
    pace = LockStep(sensors, exiting, repeat=lambda: None, patience_s=600.0)
    link.send_step(0)
    seen = sensors.observe()
    link.send(topics.CAMERA_RAW, raw(np.zeros((64, 64, 3), np.uint8), 2))
    late = threading.Timer(0.05, lambda: link.send(topics.SCAN, scan_message(OPEN, 2)))
    late.start()
    pace.wait(seen)
    assert sensors.observe().scan.stamp_ns == 2


def test_lockstep_ticks_when_one_frame_comes_again_and_again(link, sensors):
    repeated = []
    pace = LockStep(sensors, threading.Event(), lambda: repeated.append(1), patience_s=600.0)
    link.send_step(0)
    seen = sensors.observe()
    sending = threading.Event()

    def send():
        while not sending.wait(0.01):
            link.send_step(0)

    thread = threading.Thread(target=send)
    thread.start()
    pace.wait(seen)
    sending.set()
    thread.join()
    assert len(repeated) == 3


def wait_until(condition, timeout_s=20.0):
    gate = threading.Event()
    for _ in range(int(timeout_s / 0.002)):
        if condition():
            return
        gate.wait(0.002)
    pytest.fail("it never happened")


class FakeCamera:
    """Frames at the given times on a clock that waiting turns forward."""

    def __init__(self, clock, frames_s=()):
        self.clock = clock
        self.frames_s = np.asarray(frames_s)
        self.frame_received_s = -np.inf

    def observe(self):
        """A tick sees the newest frame; its age."""
        come_s = self.frames_s[self.frames_s <= self.clock.now_s + 1e-9]
        if len(come_s):
            self.frame_received_s = come_s[-1]
        return self.clock.now_s - self.frame_received_s

    def wait_for_frame_since(self, since_s, timeout_s):
        later_s = self.frames_s[self.frames_s >= since_s]
        end_s = self.clock.now_s + timeout_s
        if len(later_s) and later_s[0] <= end_s:
            self.clock.now_s = max(self.clock.now_s, later_s[0])
            return True
        self.clock.now_s = end_s
        return False


NOTHING = Observation(None, None)


def run_paced(frames_s, works_s):
    """Ticks that take so long: when each began, how old its frame was, and the pace."""
    clock = Clock()
    camera = FakeCamera(clock, frames_s)
    pace = Ratekeeper(0.1, clock, camera, clock)
    began_s, ages_s = [], []
    for work_s in works_s:
        began_s.append(clock.now_s)
        ages_s.append(camera.observe())
        clock.now_s += work_s
        pace.wait(NOTHING)
    return np.array(began_s), np.array(ages_s), pace


def test_deadlines_are_absolute_and_do_not_drift():
    began_s, _, pace = run_paced([], [0.02, 0.05, 0.0, 0.09, 0.0])
    np.testing.assert_allclose(began_s[1:] - 50.0 - WINDOW_S, [0.1, 0.2, 0.3, 0.4])
    assert pace.overruns == 0


def test_overrun_skips_ticks_and_never_bursts():
    began_s, _, pace = run_paced([], [0.35, 0.0, 0.0])
    np.testing.assert_allclose(began_s[1:] - 50.0 - WINDOW_S, [0.4, 0.5])
    assert pace.overruns == 3


@pytest.mark.parametrize("phase_s", [0.001, 0.02, 0.05, 0.08, 0.099])
def test_ticks_jump_to_the_first_camera_frame_and_then_go_with_them(phase_s):
    frames_s = 50.0 + phase_s + 0.1 * np.arange(100)
    began_s, ages_s, pace = run_paced(frames_s, [0.002] * 60)
    assert ages_s[3:].max() < 1e-6
    assert np.diff(began_s).min() > 0.045
    assert np.diff(began_s)[3:].min() > 0.095
    assert pace.overruns == 0


def test_ticks_slide_to_a_camera_whose_phase_changes():
    frames_s = np.append(50.0 + 0.1 * np.arange(20), 52.06 + 0.1 * np.arange(80))
    began_s, ages_s, _ = run_paced(frames_s, [0.002] * 60)
    assert ages_s[40:].max() < 1e-6
    assert np.diff(began_s).min() > 0.1 - 2 * WINDOW_S - 0.001


def test_frame_that_jitters_is_answered_at_once_and_the_pace_stays():
    jitter_s = np.random.default_rng(0).uniform(-0.01, 0.01, 300)
    frames_s = 50.05 + 0.1 * np.arange(300) + jitter_s
    began_s, ages_s, _ = run_paced(frames_s, [0.002] * 250)
    assert ages_s[20:].max() < 1e-6
    assert (began_s[-1] - began_s[20]) / (len(began_s) - 21) == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("rate_hz", [5.0, 7.0, 12.0, 15.0, 30.0, 90.0])
def test_camera_of_another_rate_leaves_the_ticks_at_10_hz(rate_hz):
    frames_s = 50.03 + np.arange(int(40 * rate_hz)) / rate_hz
    began_s, ages_s, pace = run_paced(frames_s, [0.002] * 300)
    assert np.diff(began_s).mean() == pytest.approx(0.1, abs=0.006)
    assert np.diff(began_s).min() > 0.1 - 2 * WINDOW_S - 0.006
    assert np.diff(began_s).max() < 0.1 + 2 * WINDOW_S + 0.006
    assert ages_s[20:].max() <= 1.0 / rate_hz + 1e-6
    assert pace.overruns == 0


def test_lost_frame_is_waited_for_within_the_window_only():
    frames_s = np.delete(50.03 + 0.1 * np.arange(100), [50, 51])
    began_s, _, pace = run_paced(frames_s, [0.002] * 80)
    assert np.diff(began_s).max() < 0.1 + WINDOW_S + 0.002
    assert pace.overruns == 0


def test_raw_camera_is_read_where_no_compressed_one_is_heard(link, sensors):
    link.send_step(3)
    frame = sensors.observe().frame
    assert frame.stamp_ns == 300_000_001
    np.testing.assert_array_equal(frame.image, picture(3))


def test_compressed_camera_is_read(link, sensors):
    link.send(topics.CAMERA, compress(np.full((120, 160, 3), 77, np.uint8), 5))
    frame = sensors.observe().frame
    assert frame.stamp_ns == 5
    assert abs(frame.image.astype(int) - 77).max() <= 1


def test_each_message_is_decoded_once(link, sensors):
    link.send_step(0)
    first, second = sensors.observe(), sensors.observe()
    assert first.frame is second.frame
    assert first.scan is second.scan


def test_unreadable_messages_become_samples_without_content(link, sensors, caplog):
    stamps = set()
    for _ in range(5):
        link.inboxes[topics.CAMERA].store(b"nonsense")
        seen = sensors.observe()
        stamps.add(seen.frame.stamp_ns)
        assert seen.frame.image is None
    assert len(stamps) == 5  # bad, not frozen
    assert len(caplog.records) == 1
    link.inboxes[topics.SCAN].store(b"nonsense")
    assert sensors.observe().scan.ranges_m is None


def test_broken_jpeg_and_senseless_scan_become_samples_without_content(link, sensors):
    picture = compress(np.zeros((120, 160, 3), np.uint8), 7)
    link.send(topics.CAMERA, replace(picture, data=picture.data[:100]))
    link.send(topics.SCAN, replace(scan_message(OPEN, 7), angle_increment_rad=0.0))
    seen = sensors.observe()
    assert seen.frame.image is None
    assert seen.scan.ranges_m is None


def test_camera_that_covers_too_little_gives_no_image(link, sensors, caplog):
    narrow = replace(MODEL_CAMERA, fx=200.0, fy=200.0)
    link.send(topics.CAMERA_INFO, CameraInfo.of(narrow, 1))
    link.send_step(0)
    assert sensors.observe().frame.image is None
    assert "half" in caplog.text
