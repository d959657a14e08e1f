"""The runtime's process on a network that fails: it stands, and goes on once the network heals."""

import re
import shutil
import subprocess
import sys
import textwrap
from contextlib import ExitStack

import pytest
from tests.sil.relay import Relay

from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.messages import TwistStamped
from cbe.robot import STEP_S, Robot

# From standing to this in the first step: faster, it had not stood.
FIRST_MPS = Robot().max_acceleration_mps2 * STEP_S + 0.01
STARTS = 3  # a starved machine may not open a link within its 3 s


@pytest.fixture
def cable():
    """Lay a relay to an endpoint."""
    with ExitStack() as relays:

        def cable(endpoint, **options):
            relay = Relay(int(endpoint.rsplit(":", 1)[1]), **options)
            relays.callback(relay.close)
            return relay

        yield cable


@pytest.fixture
def drive(start, model, route, until):
    """Start a runtime that drives the scripted robot."""

    def drive(robot, endpoint):
        arguments = ("--memory", route, "--model", model, "--connect", endpoint)
        for _ in range(STARTS):
            runtime = start("cbe-runtime", *arguments)
            driven = lambda: (robot.speed_mps or 0.0) > 0.3  # noqa: E731
            until(lambda: driven() or not runtime.running, "the robot to be driven")  # noqa: B023
            if runtime.running:
                return runtime
        return pytest.fail(runtime.output)

    return drive


def speeds(stream):
    return [TwistStamped.from_cdr(each.payload).twist.speed_mps for each in stream.drain()]


def goes_on(robot, until, stream):
    """Wait until the robot is driven again; the speeds it was told till then."""
    told = []
    until(lambda: told.extend(speeds(stream)) or max(told, default=0.0) > 0.3, "the drive to go on")
    return told


@pytest.mark.parametrize("fault", ["cut", "swallow"])
def test_runtime_stands_while_cut_and_goes_on_by_itself(
    robot, endpoint, cable, drive, until, fault
):
    relay = cable(endpoint)
    runtime = drive(robot, relay.endpoint)
    for _ in range(2):
        getattr(relay, fault)()
        stream = robot.commands()
        silence(robot, until)
        speeds(stream)  # what was on its way
        relay.heal()
        told = goes_on(robot, until, stream)
        assert told[0] <= FIRST_MPS
    assert runtime.running


def silence(robot, until):
    """Wait until nothing was heard of the runtime for a second of the robot's own steps."""
    quiet = {"heard": -1, "steps": 0, "step": robot.steps}

    def passed():
        heard = len(robot.status)
        if heard != quiet["heard"]:
            quiet.update(heard=heard, step=robot.steps)
        return robot.steps - quiet["step"] >= 10

    until(passed, "the cable to be dead")


def test_slow_and_unsteady_network_is_driven_on(robot, endpoint, cable, drive, until):
    relay = cable(endpoint, delay_s=0.05, jitter_s=0.05)
    runtime = drive(robot, relay.endpoint)
    heard = len(robot.status)
    until(lambda: len(robot.status) > heard + 20, "two seconds")
    assert runtime.running


def test_restarted_router_is_found_again_by_both_sides(make_robot, endpoint, drive, until):
    router = Link.open(LinkConfig.hub(endpoint))
    try:
        robot = make_robot(LinkConfig(connect=(endpoint,)))
        runtime = drive(robot, endpoint)
        router.close()
        stream = robot.commands()
        silence(robot, until)
        speeds(stream)
        router = Link.open(LinkConfig.hub(endpoint))
        assert goes_on(robot, until, stream)[0] <= FIRST_MPS
        assert runtime.running
    finally:
        router.close()


BLACK_HOLE = """
    import subprocess, threading, time
    from cbe.link import Link
    from cbe.linkconfig import LinkConfig
    from cbe.messages import Twist, TwistStamped
    from cbe.topics import CMD_VEL
    from cbe_runtime.linkkeeper import LinkKeeper

    def tc(command):
        subprocess.run(f"tc qdisc {command} dev lo root".split() + hole * ("add" in command),
                       check=True)

    hole = ["blackhole"]
    endpoint = "tcp/127.0.0.1:7447"
    closed = threading.Event()
    with Link.open(LinkConfig.hub(endpoint)) as hub:
        said = hub.publisher(CMD_VEL)
        command = TwistStamped(1, "base_link", Twist())
        def run():
            while not closed.wait(0.1):
                said.put(command)
        thread = threading.Thread(target=run)
        thread.start()
        with Link.open(LinkConfig(connect=(endpoint,))) as link, LinkKeeper(link) as keeper:
            latest = link.latest(CMD_VEL)
            assert latest.wait(timeout_s=60.0)
            for outage_s in (0.3, 2.5):
                tc("add")
                time.sleep(outage_s)
                before = latest.stats.received
                tc("del")
                healed_s = time.monotonic()
                assert latest.wait(before, 60.0)
                print(f"healed after {time.monotonic() - healed_s:.2f} s", flush=True)
        closed.set()
        thread.join()
"""


@pytest.mark.skipif(
    not (shutil.which("tc") and shutil.which("unshare")), reason="needs tc and unshare"
)
def test_network_that_lost_every_packet_is_found_again():
    probe = ["unshare", "-n", "sh", "-c", "ip link set lo up && tc qdisc add dev lo root blackhole"]
    if subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("this machine allows no network namespace")
    command = [
        "unshare", "-n", "sh", "-c", 'ip link set lo up && exec "$@"', "sh",
        sys.executable, "-c", textwrap.dedent(BLACK_HOLE),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert len(re.findall("healed after", done.stdout)) == 2
