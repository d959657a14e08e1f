"""Real processes over Zenoh on loopback, and a scripted robot whose sensors can be broken."""

import importlib.util
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from cbe import signature
from cbe.camera import MODEL_CAMERA
from cbe.images import compress, raw
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.messages import CameraInfo, CompressedImage
from cbe.rays import scan_message
from cbe.robot import STEP_S, Robot
from cbe.topics import CAMERA, CAMERA_INFO, CAMERA_RAW, CMD_VEL, SCAN
from cbe_runtime import routefile
from cbe_runtime.networks import Networks
from cbe_runtime.route import Precision, Route, Segment

ENTRY_POINTS = {
    "cbe-sim": "cbe_hil_sim.cli:main",
    "cbe-runtime": "cbe_runtime.cli:runtime_main",
    "cbe-teach": "cbe_runtime.cli:teach_main",
    "cbe-record": "cbe_runtime.cli:record_main",
    "cbe-replay": "cbe_runtime.cli:replay_main",
}
DEADLINE_S = 120.0  # for what takes a second on an idle machine


@pytest.fixture(scope="session")
def until():
    """Poll a condition; its first true value, or a failure that says what was waited for."""

    def until(condition, what):
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            value = condition()
            if value:
                return value
            time.sleep(0.03)
        raise AssertionError(f"waited {DEADLINE_S:g} s in vain for {what}")

    return until


class Process:
    """A command in a process of its own."""

    def __init__(self, folder, command, *arguments):
        module, function = ENTRY_POINTS[command].split(":")
        code = (
            f"import sys; sys.argv[0] = {command!r}; from {module} import {function}; "
            f"sys.exit({function}())"
        )
        self.name = command
        self._log = folder / f"{command}-{time.monotonic_ns()}.log"
        with self._log.open("wb") as output:
            self.popen = subprocess.Popen(
                [sys.executable, "-c", code, *map(str, arguments)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    @property
    def output(self):
        return self._log.read_text(errors="replace")

    @property
    def running(self):
        return self.popen.poll() is None

    def wait(self, timeout_s=DEADLINE_S):
        try:
            return self.popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self.name} did not end; it wrote:\n{self.output}") from None


@pytest.fixture
def start(tmp_path):
    """Start commands; those that still run at the test's end are killed."""
    processes = []

    def start(command, *arguments):
        processes.append(Process(tmp_path, command, *arguments))
        return processes[-1]

    yield start
    for process in reversed(processes):
        process.popen.kill()
        process.popen.wait()


@pytest.fixture
def endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class History:
    """Every JSON object under one of the robot's own keys, collected by a thread."""

    def __init__(self, link, name):
        self._inbox = link.latest_json(name)
        self._seen = []
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._collect, daemon=True)
        self._thread.start()

    def __len__(self):
        return len(self._seen)

    def __iter__(self):
        return iter(self._seen[:])

    @property
    def last(self):
        return self._seen[-1] if self._seen else {}

    def close(self):
        self._closed.set()
        self._thread.join()

    def _collect(self):
        count = 0
        while not self._closed.is_set():
            received = self._inbox.wait(after=count, timeout_s=0.1)
            if received is not None:
                count = received.count
                self._seen.append(received.message)


@dataclass
class Sensors:
    """What the scripted robot publishes; a test breaks it by setting a field."""

    camera: bool = True
    scan: bool = True
    camera_frozen: bool = False  # the same frame with the same stamp again and again
    garbage: bytes | None = None  # instead of a JPEG's bytes
    picture: np.ndarray | None = None  # (height, width, 3), instead of noise
    encoding: str | None = None  # of raw images, sent in place of JPEGs
    lost: float = 0.0  # share of camera frames
    ahead_ns: int = 0  # of stamps
    scan_angles: float = 1.0  # times the true ones, in what a scan says of its last ray
    ranges_m: np.ndarray = field(default_factory=lambda: np.full(Robot().scan_rays, 5.0))


class ScriptedRobot:
    """Publishes sensors at 10 Hz and keeps the commands it gets; it never moves."""

    def __init__(self, config):
        self.sensors = Sensors()
        self.steps = 0
        self._link = Link.open(config)
        self._commands = self._link.latest(CMD_VEL)
        self._camera = self._link.publisher(CAMERA)
        self._raw = self._link.publisher(CAMERA_RAW)
        self._info = self._link.publisher(CAMERA_INFO)
        self._scan = self._link.publisher(SCAN)
        self.status = History(self._link, "status")
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def speed_mps(self):
        """The last commanded speed; None before the first command."""
        received = self._commands.get()
        return None if received is None else received.message.twist.speed_mps

    @property
    def commanded(self):
        """How many commands came."""
        return self._commands.stats.received

    def commands(self):
        """Every command from now on."""
        return self._link.stream(CMD_VEL)

    def close(self):
        self._closed.set()
        self._thread.join()
        self.status.close()
        self._link.close()

    def _run(self):
        rng = np.random.default_rng(0)
        frame = None
        while not self._closed.wait(STEP_S):
            self.steps += 1
            sensors, stamp_ns = self.sensors, time.time_ns() + self.sensors.ahead_ns
            image = rng.integers(0, 255, (64, 64, 3), np.uint8)
            if sensors.picture is not None:
                image = sensors.picture
            if not sensors.camera_frozen or frame is None:
                frame = compress(image, stamp_ns)
                self._info.put(CameraInfo.of(MODEL_CAMERA, stamp_ns))
            if sensors.garbage is not None:
                data = np.frombuffer(sensors.garbage, np.uint8)
                self._camera.put(CompressedImage(stamp_ns, "camera_optical", "jpeg", data))
            elif sensors.encoding is not None:
                self._raw.put(replace(raw(image, stamp_ns), encoding=sensors.encoding))
            elif sensors.camera and rng.random() >= sensors.lost:
                self._camera.put(frame)
            if sensors.scan:
                scan = scan_message(sensors.ranges_m, stamp_ns)
                turned_rad = scan.angle_max_rad * sensors.scan_angles
                self._scan.put(replace(scan, angle_max_rad=turned_rad))


@pytest.fixture
def make_robot():
    """Make scripted robots on a link of any configuration."""
    robots = []

    def make_robot(config):
        robots.append(ScriptedRobot(config))
        return robots[-1]

    yield make_robot
    for robot in robots:
        robot.close()


@pytest.fixture
def robot(make_robot, endpoint):
    return make_robot(LinkConfig.hub(endpoint))


@pytest.fixture(scope="session")
def make_model():
    """Writer of tiny networks whose waypoint lies straight ahead, shared with the runtime's."""
    path = Path(__file__).parents[1] / "runtime" / "conftest.py"
    spec = importlib.util.spec_from_file_location("tiny_networks", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.make_model


@pytest.fixture(scope="session")
def model(make_model, tmp_path_factory):
    """A model that drives straight ahead and would arrive after an hour."""
    return make_model(tmp_path_factory.mktemp("straight"), ticks_to_goal=18_000)


@pytest.fixture(scope="session")
def route(model, tmp_path_factory):
    """A route for that model, long enough never to time out."""
    networks = Networks.load(model)
    precision = Precision()
    attractor = precision.attractor.pack(np.full(signature.ATTRACTOR_SIZE, 0.5, np.float32))
    embedding = precision.embedding.pack(np.zeros(signature.EMBEDDING_SIZE, np.float32))
    route = Route(
        model_id=networks.model_id,
        camera=MODEL_CAMERA,
        network_period=networks.network_period,
        precision=precision,
        attractors=(attractor, attractor),
        segments=(Segment(embedding, 36_000),),
    )
    path = tmp_path_factory.mktemp("route") / "straight.msgpack"
    routefile.save(route, path)
    return path
