import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from cbe import topics
from cbe.camera import MODEL_CAMERA
from cbe.images import compress
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.messages import CameraInfo, CompressedImage, LaserScan
from cbe.rays import scan_message
from cbe_runtime import cli, routefile
from cbe_runtime.command_runtime import add_options, parse
from cbe_runtime.mcapfile import Recorded, Recorder, read

HEAVY = ("torch", "onnx", "numba", "pybullet", "matplotlib", "scipy")
CAMERA = MODEL_CAMERA.scaled(160, 120)
DEADLINE_S = 60.0  # for what takes a second on an idle machine


def picture(step):
    return np.random.default_rng(step).integers(0, 256, (120, 160, 3), np.uint8)


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "drive.mcap"
    with Recorder(path) as recorder:
        for step in range(90):
            stamp = 1_000_000_000 + step * 100_000_000
            image = compress(picture(step), stamp)
            recorder.write(Recorded("/camera/x", CompressedImage.TYPE, image.to_cdr(), stamp))
            scan = scan_message(np.full(240, np.inf), stamp)
            recorder.write(Recorded("/scan", LaserScan.TYPE, scan.to_cdr(), stamp))
    return path


@pytest.fixture
def taught(recording, model_folder, tmp_path):
    route = tmp_path / "route.msgpack"
    assert cli.teach_main([str(recording), "-o", str(route), "--model", str(model_folder)]) == 0
    return route


def free_endpoint():
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def start(command, *arguments):
    code = f"import sys; from cbe_runtime import cli; sys.exit(cli.{command}(sys.argv[1:]))"
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ,
    )


class FakeRobot:
    """A camera and a scanner at a rate of its own, on a hub that the others connect to."""

    def __init__(self, period_s=0.05):
        self.endpoint = free_endpoint()
        self.link = Link.open(LinkConfig.hub(self.endpoint))
        self.camera = self.link.publisher(topics.CAMERA)
        self.scan = self.link.publisher(topics.SCAN)
        self.info = self.link.publisher(topics.CAMERA_INFO)
        self.commands = self.link.latest(topics.CMD_VEL)
        self.status = self.link.latest_json("status")
        self.period_s = period_s
        self.step = 0
        self.ending = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self):
        while not self.ending.wait(self.period_s):
            self.publish()

    def publish(self):
        stamp = 1 + self.step * 100_000_000
        self.info.put(CameraInfo.of(CAMERA, stamp))
        self.scan.put(scan_message(np.full(240, np.inf), stamp))
        self.camera.put(compress(picture(self.step), stamp))
        self.step += 1

    def call(self, name):
        return self.link.call(name, timeout_s=DEADLINE_S)

    def until(self, condition, timeout_s=DEADLINE_S):
        gate = threading.Event()
        for _ in range(int(timeout_s / 0.02)):
            status = self.status.get()
            if status is not None and condition(status.message):
                return status.message
            gate.wait(0.02)
        return pytest.fail(f"never; the last status was {status}")

    def close(self):
        self.ending.set()
        self.thread.join()
        self.link.close()


@pytest.fixture
def robot():
    robot = FakeRobot()
    yield robot
    robot.close()


def test_import_pulls_nothing_heavy():
    modules = [path.stem for path in Path(cli.__file__).parent.glob("*.py")]
    code = f"""
import importlib, json, sys
for name in {modules!r}:
    importlib.import_module("cbe_runtime." + name)
print(json.dumps(sorted(set(sys.modules) & set({HEAVY!r}))))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert json.loads(done.stdout) == []


def test_recording_becomes_a_route_of_equal_segments(taught, capsys):
    route = routefile.load(taught)
    assert [segment.steps for segment in route.segments] == [30, 30, 29]
    assert route.camera == CAMERA
    assert cli.route_main(["info", str(taught), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert facts["file_bytes"] == taught.stat().st_size
    assert facts["steps"] == 89
    assert facts["segments"] == 3


def test_replay_prints_one_decision_a_step(taught, recording, model_folder, capsys):
    arguments = [str(recording), "--memory", str(taught), "--model", str(model_folder)]
    assert cli.replay_main(arguments) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line[0] == "{"]
    assert len(lines) == 90
    assert lines[0]["state"] == "FOLLOWING"
    assert lines[-1]["segment"] == 2


@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (cli.runtime_main, [], "--memory"),
        (cli.runtime_main, ["--memory", "none.msgpack"], "no encoder.onnx"),
        (cli.teach_main, ["-o", "x"], "--live"),
        (cli.route_main, ["info", "none.msgpack"], "none.msgpack"),
    ],
)
def test_refusal_is_a_message_and_code_2(main, arguments, message, capsys, tmp_path, monkeypatch):
    if main is cli.runtime_main and arguments:
        arguments = [*arguments, "--model", str(tmp_path)]
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def options_of(tokens):
    import argparse

    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_options(parser)
    return parse(parser, tokens)


def test_command_line_wins_over_the_config_file(tmp_path):
    config = tmp_path / "c.toml"
    config.write_text(
        'memory = "a.msgpack"\nconnect = ["tcp/1.2.3.4:1", "tcp/1.2.3.4:2"]\ndomain = 7\n'
        "lockstep = true\ntwist = false\n[follower]\narrival_progress = 0.97\n"
    )
    options = options_of(["--config", str(config), "--domain", "8"])
    assert options.memory == Path("a.msgpack")
    assert options.connect == ["tcp/1.2.3.4:1", "tcp/1.2.3.4:2"]
    assert (options.domain, options.lockstep, options.twist) == (8, True, False)
    assert options.follower == {"arrival_progress": 0.97}
    assert options_of(["--config", str(config), "--connect=tcp/5.6.7.8:9"]).connect == [
        "tcp/5.6.7.8:9"
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[follower]\nspeed = 3", "known"),
        ("[follower]\nprogress_ticks = 'two'", "follower"),
        ("memory = 'x'\n[camera]\nwidth = 3", "camera"),
        ("memory = {a = 1}", "nothing that --memory takes"),
        ("memory = ", "no TOML"),
    ],
)
def test_wrong_config_is_refused(text, message, tmp_path, capsys):
    config = tmp_path / "c.toml"
    config.write_text(text)
    assert cli.runtime_main(["--config", str(config), "--memory", "x.msgpack"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.loopback
def test_runtime_drives_over_zenoh_and_leaves_the_robot_stopped(taught, model_folder, robot):
    process = start(
        "runtime_main", "--memory", taught, "--model", model_folder, "--connect", robot.endpoint
    )
    try:
        status = robot.until(lambda status: status["speed_mps"] > 0.2)
        assert status["state"] == "FOLLOWING"
        assert robot.call("status")["model_id"] == "00112233445566aa"
        assert robot.link.alive("runtime")
        robot.call("stop")
        robot.until(lambda status: status["reason"] == "OPERATOR")
        robot.call("start")
        robot.until(lambda status: status["speed_mps"] > 0.1)
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 0
        robot.until(lambda status: status["state"] == "EXITED")
        assert robot.commands.get().message.twist.speed_mps == 0.0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.loopback
def test_runtime_exits_with_zero_on_arrival_in_lockstep(taught, model_folder, robot):
    process = start(
        "runtime_main", "--memory", taught, "--model", model_folder, "--connect", robot.endpoint,
        "--lockstep", "--exit-when-done",
    )  # fmt: skip
    try:
        _, log = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
    assert process.returncode == 0, log
    assert "arrived" in log


@pytest.mark.loopback
def test_route_of_another_model_is_refused_at_start(taught, model_writer, tmp_path, robot):
    other = model_writer(tmp_path / "other", **{"cbe.model_id": "ffffffffffffffff"})
    process = start(
        "runtime_main", "--memory", taught, "--model", other, "--connect", robot.endpoint
    )
    _, log = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 2
    assert "re-teach" in log


@pytest.mark.loopback
def test_recording_over_zenoh_holds_what_was_sent(tmp_path, robot):
    path = tmp_path / "live.mcap"
    process = start("record_main", "-o", path, "--connect", robot.endpoint)
    try:
        begin = wait_for_process(robot, "record")
        until_step(robot, begin + 40)
        assert robot.call("record_stop")["dropped"] == 0
        assert process.wait(DEADLINE_S) == 0
    finally:
        process.kill()
        process.communicate()
    for message_type in (CompressedImage, LaserScan):
        recorded = [each for each in read(path) if each.type_name == message_type.TYPE]
        stamps = [message_type.from_cdr(each.data).stamp_ns for each in recorded]
        # The last ones may still be on their way when the recorder is told to stop.
        assert len(stamps) >= 20
        assert set(np.diff(stamps)) == {100_000_000}


@pytest.mark.loopback
def test_live_teaching_ends_by_rpc_with_a_route(tmp_path, model_folder, robot):
    path = tmp_path / "live.msgpack"
    process = start(
        "teach_main", "--live", "-o", path, "--model", model_folder, "--connect", robot.endpoint
    )
    try:
        begin = wait_for_process(robot, "teach")
        until_step(robot, begin + 60)
        robot.call("teach_stop")
        assert process.wait(DEADLINE_S) == 0
    finally:
        process.kill()
        process.communicate()
    route = routefile.load(path)
    assert route.steps >= 20
    assert route.camera == CAMERA


def wait_for_process(robot, name):
    gate = threading.Event()
    for _ in range(300):
        if robot.link.alive(name):
            return robot.step
        gate.wait(0.05)
    return pytest.fail(f"{name} never came up")


def until_step(robot, step):
    gate = threading.Event()
    for _ in range(3000):
        if robot.step >= step:
            return
        gate.wait(0.01)
    pytest.fail("the robot stands still")
