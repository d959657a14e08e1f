"""What a viewer is shown: a WebSocket client connects to a runtime's view."""

import importlib.util
import json
import socket
import struct
from contextlib import ExitStack
from pathlib import Path

import pytest

from cbe.messages import CompressedImage
from cbe_runtime.viewprocess import beside

client = pytest.importorskip("websockets.sync.client")
LAYOUT = Path(__file__).parents[2] / "docs" / "foxglove_layout.json"
SHOWN = {
    "/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/cmd_vel": "geometry_msgs/msg/TwistStamped",
    "/cbe/status": "cbe/Status",
    "/cbe/decision": "cbe/Decision",
    "/cbe/alarms": "foxglove.Log",
    "/cbe/scene": "foxglove.SceneUpdate",
    "/tf": "foxglove.FrameTransforms",
}
MESSAGE = 1  # opcode; then the subscription's id, the time, and the data

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("foxglove") is None, reason="the extra `view` is not installed"
)


@pytest.fixture
def port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def connect(port, until):
    """A viewer, connected as soon as the view is up."""
    with ExitStack() as stack:

        def connect():
            until(lambda: listening(port), "the view to listen")
            url = f"ws://127.0.0.1:{port}"
            viewer = client.connect(url, subprotocols=["foxglove.sdk.v1"], max_size=2**24)
            return stack.enter_context(viewer)

        yield connect


def advertised(viewer):
    """Channels by topic, as far as the layout needs them."""
    channels = {}
    while not SHOWN.keys() <= channels.keys():
        message = viewer.recv(timeout=60.0)
        if isinstance(message, str) and (parsed := json.loads(message))["op"] == "advertise":
            channels |= {each["topic"]: each for each in parsed["channels"]}
    return channels


def first_of_each(viewer, channels):
    """The first message of each topic."""
    ids = dict(enumerate(channels))
    subscriptions = [
        {"id": index, "channelId": channels[topic]["id"]} for index, topic in ids.items()
    ]
    viewer.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
    found = {}
    while found.keys() != set(channels):
        message = viewer.recv(timeout=60.0)
        if isinstance(message, bytes) and message[0] == MESSAGE:
            index, _ = struct.unpack_from("<IQ", message, 1)
            found.setdefault(ids[index], message[13:])
    return found


def test_runtime_shows_camera_scan_waypoint_progress_state_and_alarms(
    start, endpoint, until, robot, model, route, port, connect
):
    runtime = start(
        "cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint,
        "--view", port,
    )  # fmt: skip
    until(lambda: robot.status.last, f"the runtime to tick; {runtime.output}")
    viewer = connect()

    channels = advertised(viewer)
    assert {topic: channels[topic]["schemaName"] for topic in SHOWN} == SHOWN
    wanted = {topic: channels[topic] for topic in SHOWN if topic != "/cmd_vel"}
    found = first_of_each(viewer, wanted)

    assert CompressedImage.from_cdr(found["/camera/image_raw/compressed"]).stamp_ns > 0
    assert {"state", "progress", "waypoint_m"} <= json.loads(found["/cbe/status"]).keys()
    assert json.loads(found["/cbe/decision"])["step"] > 0

    runtime.popen.terminate()
    runtime.wait()
    until(lambda: not listening(port), "the view to end with the runtime")


def listening(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_view_ends_with_a_runtime_that_is_killed(
    start, endpoint, until, robot, model, route, port, connect
):
    runtime = start(
        "cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint, "--view", port
    )
    connect()
    runtime.popen.kill()
    until(lambda: not listening(port), "the view to end")


def test_layout_shows_only_topics_that_there_are():
    layout = json.loads(LAYOUT.read_text())
    text = json.dumps(layout["configById"])
    named = {part.split(".")[0] for part in text.split('"') if part.startswith("/")}
    assert named <= SHOWN.keys()
    assert len(named) >= 5


def test_nothing_is_shown_unless_asked_for():
    class Options:
        view = None

    with beside(Options()):
        pass
