"""A black box outlives a kill, costs the runtime nothing, and its decisions can be made again."""

import json
import signal

import numpy as np
import pytest

from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe_runtime import blackbox

STEPS = 40


@pytest.fixture
def black_box(start, endpoint, until, robot, tmp_path):
    """A running black box: its process and folder."""
    folder = tmp_path / "box"
    process = start("cbe-record", "--black-box", folder, "--connect", endpoint)
    with Link.open(LinkConfig(connect=(endpoint,))) as link:
        until(lambda: link.alive("black_box"), f"the black box to be ready; {process.output}")
    return process, folder


@pytest.fixture
def runtime(start, endpoint, black_box, model, route):
    return start("cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint)


def recorded(folder):
    """Decisions that a reader finds at present."""
    try:
        return sum(each.type_name == "cbe/Decision" for each in blackbox.read(folder))
    except blackbox.RecordingError:
        return 0


def test_decisions_of_a_killed_black_box_come_out_the_same(
    start, until, robot, black_box, runtime, model, route, tmp_path
):
    recorder, folder = black_box
    until(lambda: robot.status.last.get("state") == "FOLLOWING", f"a drive; {runtime.output}")
    robot.sensors.ranges_m = np.full(240, 0.5)  # something comes near
    until(lambda: recorded(folder) > STEPS, "enough decisions in the black box")

    recorder.popen.kill()
    recorder.wait()

    sheet = tmp_path / "sheet.png"
    replay = start("cbe-replay", folder, "--memory", route, "--model", model, "--sheet", sheet)
    code = replay.wait()
    assert "all are the same, bit for bit" in replay.output, replay.output
    assert code == 0
    lines = [json.loads(line) for line in replay.output.splitlines() if line.startswith("{")]
    assert len(lines) > STEPS
    same = [line["same"] for line in lines]  # None before the replay takes the drive up
    taken_up = same.index(True)
    assert all(each is None for each in same[:taken_up])
    assert all(same[taken_up:])
    assert sheet.read_bytes().startswith(b"\x89PNG")


def test_black_box_that_hangs_does_not_hold_up_the_runtime(until, robot, black_box, runtime):
    recorder, folder = black_box
    until(lambda: recorded(folder) > 0, f"decisions in the black box; {runtime.output}")
    recorder.popen.send_signal(signal.SIGSTOP)
    count = len(robot.status)
    until(lambda: len(robot.status) > count + STEPS, "the runtime to go on")
    assert runtime.running
    recorder.popen.send_signal(signal.SIGCONT)
