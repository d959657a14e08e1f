import socket
import threading
import time
from contextlib import contextmanager
from threading import Event

import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.errors import ConfigError, LinkError
from cbe.images import decode_image
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.messages import Twist, TwistStamped
from cbe.robot import Robot
from cbe.topics import CAMERA, CAMERA_INFO, CMD_VEL, ODOM, SCAN
from cbe_hil_sim.cli import main
from cbe_hil_sim.column import ColumnBackend
from cbe_hil_sim.process import ProcessConfig, RobotProcess

pytestmark = pytest.mark.loopback

START = [0.0, 2.0, 0.0]
DEADLINE_S = 30.0
STEP_NS = 100_000_000


class Room:
    """The process's world without files or seeds."""

    def __init__(self, world):
        self.camera, self.planning = MODEL_CAMERA.scaled(160, 120), world
        self.backend = ColumnBackend([world], np.zeros(1, np.int64), camera=self.camera)
        self.backend.reset(np.array([START]))

    def place_bin(self, pose):
        self.planning = self.planning.with_cylinder(pose[0], pose[1], 0.15, 1.0, 0)
        self.backend = ColumnBackend([self.planning], np.zeros(1, np.int64), camera=self.camera)
        self.backend.reset(np.array([START]))


@pytest.fixture
def start(make_room):
    """Run a process in a thread of this one; the link of somebody else is yielded."""

    @contextmanager
    def running(**config):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        exiting = Event()
        with Link.open(LinkConfig.hub(endpoint)) as hub:
            process = RobotProcess(
                hub, Room(make_room()), Robot(), ProcessConfig(**config), exiting
            )
            thread = threading.Thread(target=process.run)
            with Link.open(LinkConfig(connect=(endpoint,))) as link:
                thread.start()
                try:
                    # A call made before the link has heard of the process finds nobody.
                    deadline = time.monotonic() + DEADLINE_S
                    while not link.alive("sim"):
                        assert time.monotonic() < deadline
                    yield link
                finally:
                    exiting.set()
                    thread.join(DEADLINE_S)
                    assert not thread.is_alive()

    return running


class Commander:
    """Answers camera frames as a follower in lock-step does."""

    def __init__(self, link):
        self.camera, self.command = link.latest(CAMERA), link.publisher(CMD_VEL)
        self.count = 0

    def frame(self):
        received = self.camera.wait(self.count, DEADLINE_S)
        assert received is not None
        self.count = received.count
        return received.message

    def answer(self, frame, speed, yaw_rate=0.0):
        self.command.put(TwistStamped(frame.stamp_ns, "base_link", Twist.planar(speed, yaw_rate)))


def test_lockstep_steps_once_for_each_answered_frame(start):
    with start(lockstep=True) as link:
        commander = Commander(link)
        stamps = []
        for _ in range(10):
            frame = commander.frame()
            stamps.append(frame.stamp_ns)
            commander.answer(frame, 0.5)
        frame = commander.frame()
        x = link.call("pose", timeout_s=DEADLINE_S)["pose"][0]
    assert (np.diff([*stamps, frame.stamp_ns]) == STEP_NS).all()
    assert x == pytest.approx(0.42, abs=0.02)  # ten steps of 0.1 s less the acceleration's


def test_lockstep_ignores_answers_to_other_frames_and_repeats_the_frame(start):
    with start(lockstep=True) as link:
        commander = Commander(link)
        frame = commander.frame()
        for _ in range(3):
            commander.command.put(TwistStamped(frame.stamp_ns - STEP_NS, "", Twist.planar(0.5, 0)))
        again = commander.frame()
        assert again.stamp_ns == frame.stamp_ns
        assert link.call("pose", timeout_s=DEADLINE_S)["pose"] == START


def test_unanswered_moving_robot_brakes_in_lockstep(start):
    with start(lockstep=True) as link:
        commander = Commander(link)
        for _ in range(5):
            commander.answer(commander.frame(), 0.5)
        deadline = time.monotonic() + DEADLINE_S
        while abs(link.call("pose", timeout_s=DEADLINE_S)["speed_mps"]) > 0.01:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_silence_stops_the_robot_in_real_time(start):
    with start() as link:
        commander, truths = Commander(link), link.latest_json("truth")
        deadline = time.monotonic() + DEADLINE_S
        speed = 0.0
        while speed < 0.1:
            assert time.monotonic() < deadline
            commander.answer(commander.frame(), 0.3)
            speed = truths.wait(0, DEADLINE_S).message["speed_mps"]
        while speed > 1e-6:
            assert time.monotonic() < deadline
            time.sleep(0.05)
            speed = truths.get().message["speed_mps"]


def stamped(inbox, stamp_ns):
    """The message of a topic with a frame's stamp: a frame without answer is sent again."""
    received, deadline = None, time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        received = inbox.wait(received.count if received else 0, 1.0) or received
        message = received.message if received else None
        stamp = message["stamp_ns"] if isinstance(message, dict) else message and message.stamp_ns
        if stamp == stamp_ns:
            return message
    raise AssertionError(f"no message with stamp {stamp_ns}; the last was {received}")


def test_every_sensor_of_a_frame_carries_its_stamp(start):
    with start(lockstep=True) as link:
        inboxes = [link.latest(topic) for topic in (SCAN, ODOM, CAMERA_INFO)]
        truths = link.latest_json("truth")
        commander = Commander(link)
        frame = commander.frame()
        commander.answer(frame, 0.2)
        frame = commander.frame()
        scan, odom, info = (stamped(inbox, frame.stamp_ns) for inbox in inboxes)
        assert stamped(truths, frame.stamp_ns)["pose"] == pytest.approx(odom.pose)
        assert decode_image(frame).shape == (info.height, info.width, 3)
        assert info.camera().matrix == MODEL_CAMERA.scaled(160, 120).matrix
        assert len(scan.ranges_m) == Robot().scan_rays


def test_reset_puts_the_robot_at_the_pose(start):
    with start(lockstep=True) as link:
        reply = link.call("reset", {"pose": [0.5, 1.5, 1.0]}, DEADLINE_S)
        assert reply["pose"] == pytest.approx([0.5, 1.5, 1.0])
        assert reply["speed_mps"] == 0.0


@pytest.mark.parametrize(
    ("call", "request_"),
    [
        ("reset", {"pose": [1.0]}),
        ("reset", {"pose": ["a", "b", "c"]}),
        ("reset", {}),
        ("drive", {"path": [[0.0, 1.0]]}),
        ("drive", {"goal": None}),
        ("obstacle", {"pose": [[1.0, 2.0, 3.0]]}),
    ],
)
def test_malformed_call_is_refused_and_the_process_lives_on(start, call, request_):
    with start(lockstep=True) as link:
        with pytest.raises(LinkError, match="finite numbers"):
            link.call(call, request_, DEADLINE_S)
        assert link.call("pose", timeout_s=DEADLINE_S)["pose"] == START


def test_drive_follows_a_path_to_its_end_and_publishes_every_step(start):
    with start() as link:
        frames = link.stream(CAMERA, 1000)
        path = [[0.0, 1.5], [1.0, 2.0], [2.0, 2.2]]
        reply = link.call("drive", {"path": path}, 2 * DEADLINE_S)
        assert reply["arrived"], reply["reason"]
        assert reply["poses"][-1][:2] == pytest.approx(path[-1], abs=0.25)
        assert reply["poses"][0][:2] == pytest.approx(path[0])
        seen, deadline = len(frames.drain(1.0)), time.monotonic() + DEADLINE_S
        while seen < len(reply["poses"]):
            assert time.monotonic() < deadline
            seen += len(frames.drain(1.0))


def test_drive_to_a_goal_starts_from_the_present_pose(start):
    with start(lockstep=True) as link:
        reply = link.call("drive", {"goal": [2.0, 2.2]}, 2 * DEADLINE_S)
        assert reply["arrived"], reply["reason"]
        assert reply["poses"][0] == START


def test_goal_in_a_wall_is_refused(start):
    with start(lockstep=True) as link, pytest.raises(LinkError, match="obstacle"):
        link.call("drive", {"goal": [-1.0, 0.5]}, DEADLINE_S)


def test_obstacle_appears_in_the_scan(start):
    with start(lockstep=True) as link:
        scans = link.latest(SCAN)
        before = scans.wait(0, DEADLINE_S)
        link.call("obstacle", {"pose": [1.0, 2.0, 0.0]}, DEADLINE_S)
        ahead = Robot().scan_rays // 2
        after = scans.wait(before.count, DEADLINE_S)
        assert after.message.ranges_m[ahead] < before.message.ranges_m[ahead] - 0.5


def test_shutdown_ends_the_process_and_its_liveliness(start):
    with start() as link:
        assert link.alive("sim", DEADLINE_S)
        link.call("shutdown", timeout_s=DEADLINE_S)
        with pytest.raises(LinkError):
            link.call("reset", {"pose": START}, DEADLINE_S)


def test_lockstep_without_stamps_is_refused():
    with pytest.raises(ConfigError, match="stamped"):
        ProcessConfig(lockstep=True, unstamped=True)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--start", "1,2"], "x,y,yaw"),
        (["--camera-size", "big"], "WxH"),
        (["--scene", "/nowhere/at/all"], "no scene folder"),
        (["--scene", "/", "--backend", "column"], "--backend bullet"),
        (["--listen", "elsewhere"], "malformed"),
        (["--lockstep", "--twist"], "stamped"),
    ],
)
def test_unusable_option_is_refused_with_its_reason(arguments, reason, capsys):
    assert main(arguments) == 2
    assert reason in capsys.readouterr().err
