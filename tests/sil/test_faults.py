"""The runtime's process before a scripted robot whose sensors fail one at a time."""

import signal

import numpy as np
import pytest

from cbe.robot import Robot

FAULTS = {
    "frozen camera": ("camera_frozen", True, "FROZEN_CAMERA"),
    "silent camera": ("camera", False, "STALE_CAMERA"),
    "garbage image": ("garbage", b"\xff\xd8\xff\xe0 no picture", "BAD_IMAGE"),
    "empty image": ("garbage", b"", "BAD_IMAGE"),
    "silent scan": ("scan", False, "STALE_SCAN"),
    "NaN scan": ("ranges_m", np.full(Robot().scan_rays, np.nan), "BAD_SCAN"),
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
