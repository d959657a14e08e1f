"""Simulator, recorder, teacher and runtime as processes: a drive is taught once and repeated."""

import math
import signal

import numpy as np
import pytest

from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe_bench.demo_course import jittered_start
from cbe_hil_sim.demonstrator import sample_routes
from cbe_hil_sim.generate import TEST_SEEDS, generate
from cbe_runtime.networks import PACKAGED_MODELS

WORLD_SEED = TEST_SEEDS[4]
CALL_S = 60.0  # for what takes a moment on an idle machine
SUCCESS_M, SUCCESS_RAD = 0.5, math.radians(30.0)


@pytest.fixture(scope="module")
def world():
    return generate(WORLD_SEED)


@pytest.fixture(scope="module")
def straight(world):
    """A straight way (2, 2) of 4 m with 0.5 m of room on both sides."""
    rng = np.random.default_rng(0)
    free = np.argwhere(world.clearance_m > 0.5)[:, ::-1]
    points = (free + 0.5) * world.resolution_m + np.array(world.origin_m)
    for start in rng.permutation(points):
        yaw = rng.uniform(-math.pi, math.pi)
        way = start + np.linspace(0.0, 5.0, 101)[:, None] * (math.cos(yaw), math.sin(yaw))
        if world.clearance_at(way).min() > 0.4:
            return way[[0, 80]]
    raise AssertionError("the world has no straight way of 5 m")


@pytest.fixture
def simulator(start, endpoint, until):
    """Start a simulator of the column world; its process, a link to it and its truths."""
    opened = []

    def simulator(*options):
        process = start(
            "cbe-sim", "--backend", "column", "--world", WORLD_SEED, "--listen", endpoint, *options
        )
        until(lambda: not process.running or "ready" in process.output, "the simulator to be ready")
        assert process.running, process.output
        link = Link.open(LinkConfig(connect=(endpoint,)))
        opened.append(link)
        return process, link

    yield simulator
    for link in opened:
        link.close()


def taught(start, endpoint, link, until, path, model, tmp_path):
    """Have the demonstrator drive a path while it is recorded, and teach it; route and poses."""
    recording, route = tmp_path / "drive.mcap", tmp_path / "route.msgpack"
    recorder = start("cbe-record", "-o", recording, "--connect", endpoint)
    until(lambda: link.alive("record"), f"the recorder to be ready; {recorder.output}")
    drive = link.call("drive", {"path": path.tolist()}, timeout_s=60.0)
    assert drive["arrived"], drive["reason"]
    recorder.popen.send_signal(signal.SIGINT)
    assert recorder.wait() == 0
    teacher = start("cbe-teach", recording, "-o", route, "--model", model)
    assert teacher.wait() == 0, teacher.output
    return route, np.array(drive["poses"])


def test_taught_drive_is_repeated_in_lockstep(
    simulator, start, endpoint, until, straight, make_model, tmp_path
):
    heading = math.atan2(*(straight[1] - straight[0])[::-1])
    pose = [*straight[0].tolist(), heading]
    _, link = simulator("--lockstep", "--start=" + ",".join(map(str, pose)))
    # 80 steps until this model, which always drives straight on, believes that its end is near.
    model = make_model(tmp_path / "model", ticks_to_goal=41.0, **{"cbe.segment_steps": "100"})
    route, poses = taught(start, endpoint, link, until, straight, model, tmp_path)
    link.call("reset", {"pose": pose}, CALL_S)

    runtime = start(
        "cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint,
        "--clock", "sim", "--exit-when-done",
    )  # fmt: skip

    assert runtime.wait() == 0, runtime.output
    truth = link.call("pose", timeout_s=CALL_S)
    assert not truth["collided"]
    assert truth["speed_mps"] == 0.0
    assert math.dist(truth["pose"][:2], poses[-1, :2]) < SUCCESS_M


def test_shipped_model_arrives_at_the_end_of_a_taught_drive(
    simulator, start, endpoint, until, world, tmp_path
):
    path = sample_routes(world, 1, np.random.default_rng(4), 3.0, 4.0)[0]
    ahead = path[6] - path[0]
    pose = np.array([*path[0], math.atan2(ahead[1], ahead[0])])
    _, link = simulator("--lockstep", "--start=" + ",".join(map(str, pose.tolist())))
    route, poses = taught(start, endpoint, link, until, path, PACKAGED_MODELS, tmp_path)
    link.call("reset", {"pose": jittered_start(world, pose, seed=0).tolist()}, CALL_S)

    runtime = start(
        "cbe-runtime", "--memory", route, "--connect", endpoint, "--clock", "sim",
        "--exit-when-done",
    )  # fmt: skip

    assert runtime.wait() == 0, runtime.output
    truth = link.call("pose", timeout_s=CALL_S)
    turned = math.remainder(truth["pose"][2] - poses[-1, 2], math.tau)
    assert not truth["collided"]
    assert math.dist(truth["pose"][:2], poses[-1, :2]) < SUCCESS_M
    assert abs(turned) < SUCCESS_RAD


def test_killed_simulator_stops_the_runtime_cleanly(
    simulator, start, endpoint, until, model, route
):
    process, link = simulator()
    runtime = start(
        "cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint,
        "--exit-when-done", "--patience", "3",
    )  # fmt: skip
    until(
        lambda: link.call("pose", timeout_s=CALL_S)["speed_mps"] > 0.1,
        f"the robot to move; {runtime.output}",
    )

    process.popen.kill()

    assert runtime.wait() == 3, runtime.output
    assert "STALE_CAMERA" in runtime.output
    assert "Traceback" not in runtime.output


def test_killed_runtime_leaves_the_robot_stopped(simulator, start, endpoint, until, model, route):
    _, link = simulator()
    runtime = start("cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint)
    until(
        lambda: link.call("pose", timeout_s=CALL_S)["speed_mps"] > 0.1,
        f"the robot to move; {runtime.output}",
    )

    runtime.popen.kill()

    at_rest = until(lambda: _at_rest(link), "the robot to stop")
    later_ns = at_rest["stamp_ns"] + 500_000_000
    after = until(lambda: _since(link, later_ns), "half a second more")
    assert after["pose"] == at_rest["pose"]
    assert not after["collided"]


def _at_rest(link):
    truth = link.call("pose", timeout_s=CALL_S)
    return truth if truth["speed_mps"] == 0.0 else None


def _since(link, stamp_ns):
    truth = link.call("pose", timeout_s=CALL_S)
    return truth if truth["stamp_ns"] > stamp_ns else None
