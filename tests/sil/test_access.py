"""Who has no certificate, or one that is not listed, neither drives the robot nor calls it."""

import json

import numpy as np
import pytest
import zenoh

from cbe.access import AccessConfig
from cbe.errors import LinkError
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.messages import LaserScan, Twist, TwistStamped
from cbe.rays import scan_message
from cbe.tls import TlsConfig
from cbe.topics import CMD_VEL, SCAN, KeyStyle, key_expression
from cbe_runtime.keys import Authority

ROBOT = ("robot", ("127.0.0.1",))
NAMES = ("runtime", "operator", "recorder", "stranger")
ACCESS = AccessConfig(drive=("runtime",), call=("operator",), read=("recorder",))
COMMANDS_KEY = key_expression(CMD_VEL, KeyStyle.RMW_ZENOH)
ROUNDS = 5


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    Authority(folder).issue(*ROBOT)
    for name in NAMES:
        Authority(folder).issue(name)
    return folder


@pytest.fixture
def endpoint(endpoint):
    return endpoint.replace("tcp/", "tls/")


@pytest.fixture
def connect(endpoint, keys):
    """Open a link with somebody's certificate; all are closed at the end."""
    opened = []

    def connect(name, folder=keys, open_timeout_s=10.0, **options):
        tls = TlsConfig.of_folder(folder / name, **options)
        config = LinkConfig(connect=(endpoint,), tls=tls, open_timeout_s=open_timeout_s)
        opened.append(Link.open(config))
        return opened[-1]

    yield connect
    for link in opened:
        link.close()


@pytest.fixture
def robot(endpoint, keys):
    tls = TlsConfig.of_folder(keys / "robot")
    with Link.open(LinkConfig.hub(endpoint, tls=tls, access=ACCESS)) as link:
        yield link


class Driver:
    """Commands that can be told apart by their speed."""

    def __init__(self, link):
        self._publisher = link.publisher(CMD_VEL)

    def put(self, speed_mps):
        self._publisher.put(TwistStamped(1, "base_link", Twist.planar(speed_mps, 0.0)))


def speeds(stream):
    return [TwistStamped.from_cdr(each.payload).twist.speed_mps for each in stream.drain()]


def speeds_while(stream, driver, attack, until):
    """The speeds the robot was told while another attacked, and the driver drove at 0.1 m/s."""
    heard = []
    until(lambda: driver.put(0.1) or speeds(stream), "the driver to be obeyed")
    for _ in range(ROUNDS):
        attack()
        # What comes after the attack has come: so had the attack.
        heard += until(lambda: driver.put(0.1) or speeds(stream), "the driver to be obeyed")
    return heard + speeds(stream)


@pytest.mark.parametrize("name", ["stranger", "recorder", "operator"])
def test_only_the_runtime_commands(robot, connect, until, name):
    stream = robot.stream(CMD_VEL)
    runtime, other = connect("runtime"), connect(name)
    attacker = Driver(other)
    payload = TwistStamped(1, "base_link", Twist.planar(0.5, 0.0)).to_cdr()

    def attack():
        attacker.put(0.5)
        for key in ("**", "0/**", "0/cmd_vel/**", COMMANDS_KEY):
            other._session.put(key, payload)
            other._session.delete(key)

    assert set(speeds_while(stream, Driver(runtime), attack, until)) == {0.1}


def test_attacks_above_reach_a_robot_without_rules(endpoint, keys, connect, until):
    """Those tests can fail: without access rules any certificate commands."""
    with Link.open(LinkConfig.hub(endpoint, tls=TlsConfig.of_folder(keys / "robot"))) as robot:
        stream = robot.stream(CMD_VEL)
        driver, attacker = Driver(connect("runtime")), Driver(connect("stranger"))
        heard = []
        until(
            lambda: (
                heard.extend(speeds_while(stream, driver, lambda: attacker.put(0.5), until))
                or 0.5 in heard
            ),
            "the stranger to be obeyed",
        )


@pytest.mark.parametrize("name", ["stranger", "recorder"])
def test_captured_command_sent_again_is_refused(robot, connect, until, name):
    stream, driver = robot.stream(CMD_VEL), Driver(connect("runtime"))
    captured = []
    recorder = connect("recorder")
    spy = recorder._session.declare_subscriber(COMMANDS_KEY, captured.append)
    until(lambda: driver.put(0.5) or captured, "a command to be captured")
    spy.undeclare()
    until(lambda: driver.put(0.1) or speeds(stream)[-1:] == [0.1], "the last captured one to pass")
    replayer = recorder if name == "recorder" else connect(name)
    sample = captured[0]

    def replay():
        attachment = sample.attachment.to_bytes()
        replayer._session.put(COMMANDS_KEY, sample.payload.to_bytes(), attachment=attachment)

    assert set(speeds_while(stream, driver, replay, until)) == {0.1}


@pytest.mark.parametrize("rpc", ["start", "stop"])
def test_only_the_operator_calls(robot, connect, until, rpc):
    runtime, calls = connect("runtime"), []
    runtime.serve(rpc, lambda request: calls.append(request) or {"done": True})

    assert connect("operator").call(rpc, {"by": "operator"}, timeout_s=10.0) == {"done": True}
    for name in ("stranger", "recorder"):
        with pytest.raises(LinkError, match=r"nobody answers.*may this certificate call it"):
            connect(name).call(rpc, {"by": name}, timeout_s=0.5)
    assert calls == [{"by": "operator"}]


def test_stranger_cannot_answer_for_the_runtime(robot, connect):
    connect("stranger").serve("stop", lambda _: {"by": "stranger"})
    connect("recorder").serve("stop", lambda _: {"by": "recorder"})
    connect("runtime").serve("stop", lambda _: {"by": "runtime"})
    operator = connect("operator")
    for _ in range(ROUNDS):
        assert operator.call("stop", timeout_s=10.0) == {"by": "runtime"}


def test_reader_can_be_told_to_end(robot, connect):
    connect("recorder").serve("record_stop", lambda _: {"messages": 7})
    assert connect("operator").call("record_stop", timeout_s=10.0) == {"messages": 7}


def test_runtime_that_listens_hears_only_its_robot(endpoint, keys, connect, until):
    """The other way round: the robot connects to the runtime, and is listed to sense."""
    config = LinkConfig.hub(
        endpoint,
        tls=TlsConfig.of_folder(keys / "robot"),
        access=AccessConfig(sense=("runtime",), read=("recorder",)),
    )
    with Link.open(config) as hub:
        scans, drive = hub.stream(SCAN), Driver(hub)
        listed, others = connect("runtime"), [connect("stranger"), connect("recorder")]
        commands, true_scans = listed.stream(CMD_VEL), listed.publisher(SCAN)
        forged = [other.publisher(SCAN) for other in others]
        heard = []
        for _ in range(ROUNDS):
            for publisher in forged:
                publisher.put(scan_message(np.full(240, 0.1), stamp_ns=666))
            scan = scan_message(np.full(240, 5.0), stamp_ns=1)
            heard += until(lambda: true_scans.put(scan) or scans.drain(), "the robot's scan")  # noqa: B023
        assert {LaserScan.from_cdr(each.payload).stamp_ns for each in heard} == {1}
        until(lambda: drive.put(0.1) or speeds(commands), "the robot to be driven")


def test_stranger_hears_nothing_and_shows_as_nobody(robot, connect, until):
    driver = Driver(connect("runtime"))
    stranger, recorder = connect("stranger"), connect("recorder")
    secret, heard = stranger.stream(CMD_VEL), recorder.stream(CMD_VEL)
    stranger.declare_alive("runtime")
    for _ in range(ROUNDS):
        until(lambda: driver.put(0.1) or speeds(heard), "the recorder to hear")
    assert speeds(secret) == []
    assert not recorder.alive("runtime")


def test_certificate_of_another_authority_opens_no_link(robot, connect, tmp_path):
    Authority(tmp_path).issue("runtime")
    with pytest.raises(LinkError, match="certificates are of one authority"):
        connect("runtime", folder=tmp_path, open_timeout_s=1.0)


def test_no_certificate_opens_no_link(robot, connect, endpoint, keys, tmp_path):
    (tmp_path / "nobody").mkdir()
    (tmp_path / "nobody" / "ca.pem").write_bytes((keys / "robot" / "ca.pem").read_bytes())
    with pytest.raises(LinkError, match="no answer"):
        connect("nobody", folder=tmp_path, mutual=False, open_timeout_s=1.0)
    with pytest.raises(LinkError, match="no answer"):
        Link.open(LinkConfig(connect=(endpoint.replace("tls/", "tcp/"),), open_timeout_s=1.0))


def test_robot_certified_for_another_host_is_not_believed(endpoint, keys, connect, tmp_path):
    (tmp_path / "authority").symlink_to(keys / "authority")
    tls = TlsConfig.of_folder(Authority(tmp_path).issue("elsewhere", ("elsewhere.example",)))
    with Link.open(LinkConfig.hub(endpoint, tls=tls)):
        with pytest.raises(LinkError, match="names that host"):
            connect("runtime", open_timeout_s=1.0)
        connect("runtime", verify_name=False)


def test_name_of_a_connected_session_cannot_be_taken_over(robot, connect, endpoint, keys, until):
    """Zenoh keeps one link to each session's id: a second claim to it is refused."""
    stream, runtime = robot.stream(CMD_VEL), connect("runtime")
    driver = Driver(runtime)
    until(lambda: driver.put(0.1) or speeds(stream), "the driver to be obeyed")
    tls = TlsConfig.of_folder(keys / "recorder")
    settings = zenoh.Config()
    for key, value in LinkConfig(connect=(endpoint,), tls=tls).zenoh_json5().items():
        settings.insert_json5(key, value)
    settings.insert_json5("id", json.dumps(str(runtime._session.zid())))
    settings.insert_json5("connect/timeout_ms", "1000")
    with pytest.raises(zenoh.ZError):
        zenoh.open(settings)
    until(lambda: driver.put(0.1) or speeds(stream), "the driver to be obeyed still")


def test_processes_with_keys_let_only_the_operator_stop_a_drive(
    start, endpoint, keys, connect, model, route, until
):
    simulator = start(
        "cbe-sim", "--backend", "column", "--listen", endpoint, "--keys", keys / "robot",
        "--allow-drive", "runtime", "--allow-call", "operator",
    )  # fmt: skip
    until(lambda: "ready" in simulator.output or not simulator.running, "the simulator")
    assert simulator.running, simulator.output
    settings = keys / "runtime.toml"
    settings.write_text(f'connect = ["{endpoint}"]\nkeys = "{keys / "runtime"}"\n')
    runtime = start("cbe-runtime", "--memory", route, "--model", model, "--config", settings)
    operator, stranger = connect("operator"), connect("stranger")
    status = operator.latest_json("status")
    state = lambda: (seen := status.get()) and seen.message and seen.message["state"]  # noqa: E731
    until(lambda: state() == "FOLLOWING" or not runtime.running, "the drive")
    assert runtime.running, runtime.output

    with pytest.raises(LinkError):
        stranger.call("stop", timeout_s=0.5)
    assert state() == "FOLLOWING"
    assert operator.call("stop", timeout_s=10.0)
    until(lambda: state() != "FOLLOWING", "the drive to be stopped")


def test_process_with_a_bad_key_says_so_and_ends(start, endpoint, keys, model, route, tmp_path):
    folder = tmp_path / "runtime"
    folder.mkdir()
    for path in (keys / "runtime").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "key.pem").chmod(0o644)
    runtime = start(
        "cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint,
        "--keys", folder,
    )  # fmt: skip
    assert runtime.wait() == 2
    assert "chmod 600" in runtime.output
    assert "Traceback" not in runtime.output
