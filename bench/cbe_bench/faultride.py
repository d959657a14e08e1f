"""One closed-loop episode over a faulty link: robot and runtime each by their own clock."""

from dataclasses import dataclass
from threading import Event
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA
from cbe.errors import CbeError
from cbe.images import raw
from cbe.messages import CameraInfo, CompressedImage, Image, Twist, TwistStamped
from cbe.rays import scan_message
from cbe.robot import STEP_S, Robot
from cbe.topics import CAMERA, CAMERA_INFO, CAMERA_RAW, CMD_VEL, SCAN
from cbe_bench.episode import BRAKING_STEPS, Driver, Judge, Outcome
from cbe_bench.faultlink import CLEAR, FaultyLink, Lane, Timeline
from cbe_bench.faultlist import Fault, Shot
from cbe_bench.place import See
from cbe_hil_sim.backend import Backend
from cbe_hil_sim.process import DEADMAN_S, INFO_STEPS
from cbe_runtime.decision import Decision
from cbe_runtime.loop import OLD_DECISION_S
from cbe_runtime.pace import Ratekeeper
from cbe_runtime.sensors import Sensors
from cbe_runtime.state import Reason, State
from cbe_runtime.view import View

if TYPE_CHECKING:
    from cbe.link import Link

MAGNIFIED = 2
"""Each of the view's pixels is sent as 2 x 2, so that JPEG's halved colour costs nothing."""
CAMERA_MODEL = MODEL_CAMERA.scaled(MAGNIFIED * 64, MAGNIFIED * 64)
OBEYED_S = 0.04
"""From taking a picture to moving on: a command that comes later counts for the next step."""
TICK_S = 0.003
EARLIEST, LATEST = 0.25, 0.6
"""When a fault strikes, as shares of the demonstration's time."""
_MOVING_MPS = 0.05


@dataclass(frozen=True, slots=True)
class FaultyRide:
    """How it ended, and how soon the robot obeyed a zero speed and stood once it was struck.

    Both None where it was not struck while moving; inf where that never came about.
    """

    outcome: Outcome
    steps: int
    zero_s: float | None = None
    stop_s: float | None = None


def ride(
    driver: Driver,
    backend: Backend,
    see: See,
    demonstration: NDArray[np.float64],
    start: NDArray[np.float64],
    fault: Fault,
    rng: np.random.Generator,
) -> FaultyRide:
    """Let `driver` repeat `demonstration` (T, 3) from rest at `start` (3,) under a fault.

    Raises:
        CbeError: the networks failed.
    """
    timeline = Timeline()
    link = FaultyLink(timeline, rng)
    onset = rng.uniform(EARLIEST, LATEST) * STEP_S * len(demonstration)
    robot = _Robot(timeline, link, backend, see, fault, float(onset), rng)
    sensors = Sensors(cast("Link", link), View(), Robot())
    backend.reset(start[None])
    robot.begin(Judge(demonstration, start))
    timeline.advance(rng.uniform(0.0, STEP_S))  # the two know nothing of each other's clock
    pace = Ratekeeper(STEP_S, _Waiting(timeline), _Camera(timeline, sensors), timeline.clock)
    driver.start()
    while robot.ended is None:
        if fault.pauses and robot.struck:
            timeline.advance(robot.healed_s)
        _spend(timeline, fault, robot, rng)
        began_s, observation = timeline.now_s, sensors.observe()
        decision = driver.step(observation, began_s)
        if decision.reason is Reason.MODEL_FAULT:
            raise CbeError("the follower stopped in simulation: its networks failed")
        _spend(timeline, fault, robot, rng, TICK_S)
        robot.command(decision, old=timeline.now_s - began_s > OLD_DECISION_S)
        pace.wait(observation)
    return robot.ended


def _spend(
    timeline: Timeline, fault: Fault, robot: "_Robot", rng: np.random.Generator, busy_s: float = 0.0
) -> None:
    waits_s = fault.load.wait_s(rng) if fault.load and robot.struck else 0.0
    timeline.advance(timeline.now_s + busy_s + waits_s)


class _Waiting(Event):
    """Never set: waiting for it passes simulated time."""

    def __init__(self, timeline: Timeline) -> None:
        super().__init__()
        self._timeline = timeline

    def wait(self, timeout: float | None = None) -> bool:
        self._timeline.advance(self._timeline.now_s + (timeout or 0.0))
        return False


class _Camera:
    """`pace.Camera` in simulated time."""

    def __init__(self, timeline: Timeline, sensors: Sensors) -> None:
        self._timeline, self._sensors = timeline, sensors

    @property
    def frame_received_s(self) -> float:
        return self._sensors.frame_received_s

    def wait_for_frame_since(self, since_s: float, timeout_s: float) -> bool:
        def came() -> bool:
            return self._sensors.wait_for_frame_since(since_s, 0.0)

        if not came():
            self._timeline.advance(self._timeline.now_s + timeout_s, until=came)
        return came()


class _Robot:
    """Publishes what it sees each 0.1 s, and obeys commands no older than `DEADMAN_S`."""

    def __init__(
        self,
        timeline: Timeline,
        link: FaultyLink,
        backend: Backend,
        see: See,
        fault: Fault,
        onset_s: float,
        rng: np.random.Generator,
    ) -> None:
        self._timeline, self._link, self._backend, self._see = timeline, link, backend, see
        self._fault, self._rng = fault, rng
        self._onset_s = onset_s if fault.strikes else 0.0
        self.healed_s = self._onset_s + fault.lasts_s
        self._commands = link.latest(CMD_VEL)
        self._decision: Decision | None = None
        self._healthy: Shot | None = None
        self._steps = 0
        self._arrived_step: int | None = None
        self._struck_moving: bool | None = None
        self._zero_s = self._stop_s = float("inf")
        self.ended: FaultyRide | None = None

    @property
    def struck(self) -> bool:
        """Whether the fault is there now."""
        return self._onset_s <= self._timeline.now_s < self.healed_s

    def begin(self, judge: Judge) -> None:
        """Take the first step, and from then on one each 0.1 s."""
        self._judge = judge
        self._sense()

    def command(self, decision: Decision, *, old: bool) -> None:
        """Send what the follower decided, or a stop where that took it too long."""
        self._decision = decision
        twist = Twist() if old else Twist.planar(decision.speed_mps, decision.yaw_rate_rad_s)
        stamp_ns = round(1e9 * self._timeline.now_s)
        lane = self._fault.commands if self.struck else CLEAR
        if self._struck_moving is not None and twist == Twist() and lane == CLEAR:
            self._zero_s = min(self._zero_s, self._timeline.now_s - self._onset_s)
        self._link.send(CMD_VEL, TwistStamped(stamp_ns, "base_link", twist), lane, self.healed_s)

    def _sense(self) -> None:
        if self.ended is not None:
            return
        now_s, fault, struck = self._timeline.now_s, self._fault, self.struck
        self._timeline.at(now_s + OBEYED_S, self._move)
        self._timeline.at(now_s + STEP_S, self._sense)
        seen = self._backend.observe()
        image = self._see(seen.images[0]).repeat(MAGNIFIED, axis=0).repeat(MAGNIFIED, axis=1)
        shot = Shot(image, round(1e9 * now_s) + (fault.jump_ns if struck else 0))
        if self._steps % INFO_STEPS == 0:
            self._link.send(CAMERA_INFO, CameraInfo.of(CAMERA_MODEL, shot.stamp_ns))
        scan = scan_message(seen.scans_m[0], shot.stamp_ns)
        if struck and fault.spoil_scan is not None:
            scan = fault.spoil_scan(scan)
        self._link.send(SCAN, scan, fault.scan if struck else CLEAR, self.healed_s)
        self._film(shot, fault.camera if struck else CLEAR)

    def _film(self, shot: Shot, lane: Lane) -> None:
        message: CompressedImage | Image
        spoil = self._fault.spoil_image if self.struck else None
        if spoil is None:
            self._healthy = shot
            message = raw(shot.image, shot.stamp_ns) if self._fault.raw else shot.message()
        else:
            message = spoil(shot, self._healthy or shot, self._rng)
        if isinstance(message, Image):
            self._link.send(CAMERA_RAW, message, lane, self.healed_s)
        else:
            self._link.send(CAMERA, message, lane, self.healed_s)

    def _move(self) -> None:
        """Drive on for 0.1 s by the newest command, and judge where that led."""
        if self.ended is not None:
            return
        speed_mps, yaw_rate_rad_s = self._obeyed()
        self._backend.step(np.array([speed_mps]), np.array([yaw_rate_rad_s]))
        before_mps = self._judge.moved_m / STEP_S
        self._judge.moved(self._backend)
        self._steps += 1
        if self._fault.strikes and self.struck:
            self._time(speed_mps, before_mps)
        outcome = self._judged()
        if outcome is not None:
            moving = bool(self._struck_moving)
            times = (self._zero_s, self._stop_s) if moving else (None, None)
            self.ended = FaultyRide(outcome, self._steps, *times)

    def _time(self, speed_mps: float, before_mps: float) -> None:
        """Note when the struck robot first obeyed a zero speed, and first stood."""
        if self._struck_moving is None:
            self._struck_moving = before_mps > _MOVING_MPS
        since_s = self._timeline.now_s - self._onset_s
        if speed_mps == 0.0:
            self._zero_s = min(self._zero_s, since_s)
        if self._judge.standing:
            self._stop_s = min(self._stop_s, since_s)

    def _obeyed(self) -> tuple[float, float]:
        received = self._commands.get()
        if received is None or self._timeline.now_s - received.received_s > DEADMAN_S:
            return 0.0, 0.0
        assert received.message is not None
        twist = received.message.twist
        return twist.speed_mps, twist.yaw_rate_rad_s

    def _judged(self) -> Outcome | None:
        """How the episode ended, if it did."""
        decision, judge = self._decision, self._judge
        if bool(self._backend.collided[0]):
            return Outcome.COLLISION
        if decision is None:
            return None
        if decision.state is State.ARRIVED and self._arrived_step is None:
            self._arrived_step = self._steps
        if self._arrived_step is None:
            return judge.failure(decision)
        if judge.standing or self._steps - self._arrived_step >= BRAKING_STEPS:
            return judge.arrival()
        return None
