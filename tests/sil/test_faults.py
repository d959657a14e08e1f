"""The runtime's process before a scripted robot whose sensors fail one at a time."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from cbe.images import compress
from cbe.robot import Robot

RAYS = Robot().scan_rays
NOISE = np.random.default_rng(1).integers(0, 255, (64, 64, 3), np.uint8)
JPEG = compress(NOISE, 0).data.tobytes()
FAULTS = {
    "frozen camera": ("camera_frozen", True, "FROZEN_CAMERA"),
    "silent camera": ("camera", False, "STALE_CAMERA"),
    "garbage image": ("garbage", b"\xff\xd8\xff\xe0 no picture", "BAD_IMAGE"),
    "empty image": ("garbage", b"", "BAD_IMAGE"),
    "truncated image": ("garbage", JPEG[: len(JPEG) // 2], "BAD_IMAGE"),
    "image of another size": ("picture", NOISE[:32], "BAD_IMAGE"),
    "black image": ("picture", np.zeros_like(NOISE), "BLANK_IMAGE"),
    "white image": ("picture", np.full_like(NOISE, 255), "BLANK_IMAGE"),
    "same image with new stamps": ("picture", NOISE, "FROZEN_CAMERA"),
    "silent scan": ("scan", False, "STALE_SCAN"),
    "NaN scan": ("ranges_m", np.full(RAYS, np.nan), "BAD_SCAN"),
    "scan without a return": ("ranges_m", np.full(RAYS, np.inf), "BAD_SCAN"),
    "negative scan": ("ranges_m", np.full(RAYS, -1.0), "BAD_SCAN"),
    "empty scan": ("ranges_m", np.zeros(0), "BAD_SCAN"),
    "scan of wrong angles": ("scan_angles", 1.2, "BAD_SCAN"),
}
HARMLESS = {
    "three frames of ten lost": ("lost", 0.3),
    "clock set forward": ("ahead_ns", 3_600_000_000_000),
    "clock set back": ("ahead_ns", -3_600_000_000_000),
}


@pytest.fixture
def driving(start, endpoint, robot, model, route, until):
    """A runtime that drives the scripted robot."""
    runtime = start("cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint)
    until(lambda: robot.speed_mps, f"the robot to be driven; {runtime.output}")
    return runtime


@pytest.mark.parametrize(("field", "value", "reason"), FAULTS.values(), ids=FAULTS.keys())
def test_broken_sensor_stops_the_robot_until_it_works_again(
    driving, robot, until, field, value, reason
):
    healthy = getattr(robot.sensors, field)

    setattr(robot.sensors, field, value)
    until(lambda: robot.status.last.get("reason") == reason, f"STOPPED for {reason}")
    assert robot.status.last["state"] == "STOPPED"
    until(lambda: robot.speed_mps == 0.0, "a stop command")

    setattr(robot.sensors, field, healthy)
    until(lambda: robot.status.last["state"] == "FOLLOWING", "the runtime to go on")
    until(lambda: robot.speed_mps > 0.0, "the robot to be driven again")
    assert driving.running


@pytest.mark.parametrize(("field", "value"), HARMLESS.values(), ids=HARMLESS.keys())
def test_runtime_drives_on_whatever_else_happens(driving, robot, until, field, value):
    setattr(robot.sensors, field, value)
    _drives_for(robot, until, statuses=20)
    assert driving.running


def test_unknown_encoding_of_raw_images_stops_the_robot(
    start, endpoint, robot, model, route, until
):
    robot.sensors.encoding = "rgb8"
    runtime = start("cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint)
    until(lambda: robot.speed_mps, f"the robot to be driven; {runtime.output}")

    robot.sensors.encoding = "yuv422_yuy2"
    until(lambda: robot.status.last.get("reason") == "BAD_IMAGE", "STOPPED for BAD_IMAGE")
    until(lambda: robot.speed_mps == 0.0, "a stop command")


def test_suspended_runtime_drives_on_once_it_is_resumed(driving, robot, until):
    driving.popen.send_signal(signal.SIGSTOP)
    before = robot.status.last
    os.waitid(os.P_PID, driving.popen.pid, os.WSTOPPED | os.WNOWAIT)
    silent = robot.commanded  # what was on its way may still come
    driving.popen.send_signal(signal.SIGCONT)

    until(lambda: robot.commanded > silent + 5, "commands after the pause")
    _drives_for(robot, until, statuses=5)
    assert robot.status.last["hangs"] == before["hangs"]  # a pause is no hang


def test_runtime_drives_on_beside_two_busy_processes_on_its_core(driving, robot, until):
    core = min(os.sched_getaffinity(0))
    os.sched_setaffinity(driving.popen.pid, {core})
    busy = f"import os\nos.sched_setaffinity(0, {{{core}}})\nwhile True: pass"
    neighbours = [subprocess.Popen([sys.executable, "-c", busy]) for _ in range(2)]
    try:
        _drives_for(robot, until, statuses=20)
    finally:
        for neighbour in neighbours:
            neighbour.kill()
            neighbour.wait()


def _drives_for(robot, until, statuses):
    """So many statuses, and then one that drives: a loaded machine may be late now and then."""
    begun = len(robot.status)
    until(lambda: len(robot.status) >= begun + statuses, "more statuses")
    until(lambda: robot.status.last["state"] == "FOLLOWING", "the runtime to follow")
    until(lambda: robot.speed_mps > 0.0, "the robot to be driven")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_runtime_ends_with_a_stop_command_on_a_signal(driving, robot, until, number):
    driving.popen.send_signal(number)

    assert driving.wait() == 0
    until(lambda: robot.speed_mps == 0.0, "a stop command")
    until(lambda: robot.status.last["state"] == "EXITED", "the last status")


def test_sensors_that_never_come_end_the_runtime_stopped(
    start, endpoint, robot, model, route, until
):
    robot.sensors.camera = False
    runtime = start(
        "cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint,
        "--exit-when-done", "--patience", "0.2",
    )  # fmt: skip

    assert runtime.wait() == 3
    assert "STALE_CAMERA" in runtime.output
    assert all(status["speed_mps"] == 0.0 for status in robot.status)
