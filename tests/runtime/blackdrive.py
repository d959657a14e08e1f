"""A follower driven in memory, with all that happens on a bad day, and recorded."""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from cbe.camera import MODEL_CAMERA
from cbe.images import compress
from cbe.messages import CompressedImage
from cbe.rays import resample, scan_message
from cbe.robot import Robot
from cbe_runtime.decisionlog import DecisionLog
from cbe_runtime.mcapfile import Recorded
from cbe_runtime.observation import Frame, Observation, Scan
from cbe_runtime.view import View

STEP_NS = 100_000_000
CAMERA = "/camera/image_raw/compressed"


@dataclass
class Recorder:
    """A link whose only subscriber keeps what comes, as it would be written."""

    messages: list = field(default_factory=list)
    time_ns: int = 0
    calibration: object = MODEL_CAMERA

    def json_publisher(self, name):
        return self

    def put(self, message):
        data = msgspec.json.encode(message)
        self.messages.append(Recorded("/cbe/decision", "cbe/Decision", data, self.time_ns))


class Drive:
    """Steps a follower; sensors, clock and faults are drawn from a seed."""

    def __init__(self, follower, seed=0, first_ns=1_000_000_000):
        self.follower = follower
        self.recorder = Recorder(time_ns=first_ns)
        self.log = DecisionLog(self.recorder, follower, self.recorder)
        self.decisions = []
        self._rng = np.random.default_rng(seed)
        self._view = View(MODEL_CAMERA)
        self._frame = self._scan = None
        self._now_s = 500.0 + self._rng.random()

    @property
    def messages(self):
        return self.recorder.messages

    def step(self, steps=1, camera=True, scan=True, broken=False):
        for _ in range(steps):
            stamp_ns = self.recorder.time_ns
            if camera:
                self._frame = self._framed(stamp_ns, broken)
            if scan:
                ranges_m = self._rng.uniform(1.0, 9.0, 240)
                message = scan_message(ranges_m, stamp_ns)
                self._record("/scan", message)
                received_s = self._now_s - 0.01 * self._rng.random()
                self._scan = Scan(resample(message, Robot()), received_s, stamp_ns)
            seen = Observation(self._frame, self._scan)
            decision = self.follower.step(seen, self._now_s)
            self.log.put(seen, self._now_s, decision)
            self.decisions.append(decision)
            self.recorder.time_ns += STEP_NS
            self._now_s += self._rng.uniform(0.08, 0.12)

    def _framed(self, stamp_ns, broken):
        received_s = self._now_s - 0.01 * self._rng.random()
        picture = self._rng.integers(0, 255, (64, 64, 3), np.uint8)
        message = compress(picture, stamp_ns)
        if broken:
            message = CompressedImage(stamp_ns, "x", "jpeg", np.zeros(30, np.uint8))
            self._record(CAMERA, message)
            return Frame(None, received_s, -len(self.messages))
        self._record(CAMERA, message)
        return Frame(self._view(message), received_s, stamp_ns)

    def _record(self, topic, message):
        self.messages.append(
            Recorded(topic, type(message).TYPE, message.to_cdr(), self.recorder.time_ns)
        )


def bad_day(follower):
    """A wait, a start, a dead camera and lidar, broken images, a stop, the end, and once more."""
    drive = Drive(follower)
    drive.step(3)
    follower.start()
    drive.step(20)
    drive.step(6, camera=False)
    drive.step(20)
    drive.step(5, scan=False)
    drive.step(2, broken=True)
    drive.step(3)
    follower.stop()
    drive.step(4)
    follower.start()
    drive.step(80)
    follower.start()
    drive.step(30)
    return drive
