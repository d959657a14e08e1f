"""The robot process: a simulated robot on Zenoh that publishes sensors and obeys cmd_vel."""

import logging
import math
import os
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.errors import CbeError, ConfigError, LinkError
from cbe.geometry import relative
from cbe.images import compress, raw
from cbe.link import Link
from cbe.messages import CameraInfo, Odometry
from cbe.rays import scan_message
from cbe.robot import STEP_S, Robot
from cbe.topics import CAMERA, CAMERA_INFO, CAMERA_RAW, CMD_VEL, CMD_VEL_UNSTAMPED, ODOM, SCAN
from cbe_hil_sim.astar import plan
from cbe_hil_sim.backend import Observation
from cbe_hil_sim.demonstrator import start_pose
from cbe_hil_sim.driver import Driver
from cbe_hil_sim.simworld import SimWorld

logger = logging.getLogger(__name__)

STEP_NS = round(STEP_S * 1e9)
DEADMAN_S = 0.3
REPUBLISH_S = 1.0  # of wall time without an answer to a frame in lock-step
ABANDONED = 3  # unanswered publications after which a moving robot brakes by itself
INFO_STEPS = 10
POLL_S = 0.05
REQUEST_PATIENCE_S = 600.0
DRIVE_PERIOD_S = 0.01  # at least, so that a recorder on the same cores keeps up
CALM_MPS = 0.01

JsonObject = dict[str, Any]
Handler = Callable[[JsonObject], JsonObject]


@dataclass(frozen=True, slots=True)
class ProcessConfig:
    """How the process runs.

    `lockstep` steps once for every answered frame instead of by the clock; `raw` publishes
    Image in place of JPEG; `unstamped` obeys Twist in place of TwistStamped, in real time only.
    """

    lockstep: bool = False
    raw: bool = False
    unstamped: bool = False
    max_s: float = math.inf

    def __post_init__(self) -> None:
        """Refuse what cannot work together."""
        if self.lockstep and self.unstamped:
            raise ConfigError("lock-step needs stamped commands; use either --lockstep or --twist")


class RobotProcess:
    """One robot in one world on one link.

    Stamps are simulated time, in real time too, so that a drive faster than real time leaves
    no gap or jump.
    """

    def __init__(
        self,
        link: Link,
        world: SimWorld,
        robot: Robot,
        config: ProcessConfig,
        exiting: Event,
    ) -> None:
        """Declare what is published and served; `exiting` ends `run` when set."""
        self._world, self._robot, self._config = world, robot, config
        self._exiting = exiting
        self._parent, self._end_s = os.getppid(), math.inf
        self._stamp_ns = STEP_NS
        self._steps = 0
        self._unanswered = 0
        self._last_poses = world.backend.poses
        self._requests: queue.SimpleQueue[tuple[Handler, JsonObject, Future[JsonObject]]] = (
            queue.SimpleQueue()
        )
        self._camera = link.publisher(CAMERA)
        self._camera_raw = link.publisher(CAMERA_RAW)
        self._info = link.publisher(CAMERA_INFO)
        self._scan = link.publisher(SCAN)
        self._odom = link.publisher(ODOM)
        self._truths = link.json_publisher("truth")
        self._truth: JsonObject = self._measure()
        self._stamped = None if config.unstamped else link.latest(CMD_VEL)
        self._unstamped = link.latest(CMD_VEL_UNSTAMPED) if config.unstamped else None
        for name, handler in (
            ("reset", self._reset), ("obstacle", self._obstacle), ("drive", self._drive),
        ):  # fmt: skip
            link.serve(name, self._queued(handler))
        link.serve("pose", lambda _request: self._truth)
        link.serve("shutdown", self._shutdown)
        link.declare_alive("sim")

    def run(self) -> None:
        """Publish, wait for the command, step; until told to exit, or an orphan."""
        due_s = time.monotonic()
        self._end_s = due_s + self._config.max_s
        try:
            while not self._ending():
                if self._serve():
                    due_s = time.monotonic()
                stamp_ns, seen = self._stamp_ns, self._publish()
                if self._config.lockstep:
                    twist = self._await_answer(seen)
                else:
                    due_s = max(due_s + STEP_S, time.monotonic())  # missed deadlines are skipped
                    self._exiting.wait(max(due_s - time.monotonic(), 0.0))
                    twist = self._newest_command()
                if twist is not None and stamp_ns == self._stamp_ns:
                    self._advance(*twist)
        finally:
            self._exiting.set()
            self._refuse_requests()

    def _ending(self) -> bool:
        """Whether it was told to exit, its time is up, or its parent is gone."""
        orphaned = os.getppid() != self._parent
        late = time.monotonic() > self._end_s
        if (orphaned or late) and not self._exiting.is_set():
            logger.warning("ending: %s", "the parent process ended" if orphaned else "time is up")
            self._exiting.set()
        return self._exiting.is_set()

    def _publish(self) -> Observation:
        """Observe and send everything of this step; the camera last, as it sets the pace."""
        seen = self._world.backend.observe()
        self._truth = self._measure()
        self._send(seen, with_info=self._steps % INFO_STEPS == 0)
        return seen

    def _send(self, seen: Observation, *, with_info: bool) -> None:
        stamp_ns, image = self._stamp_ns, seen.images[0]
        self._truths.put(self._truth)
        if with_info:
            self._info.put(CameraInfo.of(self._world.camera, stamp_ns))
        x, y, yaw = self._truth["pose"]
        speed, rate = self._truth["speed_mps"], self._truth["yaw_rate_rad_s"]
        self._odom.put(Odometry.planar(stamp_ns, (x, y, yaw), speed, rate))
        self._scan.put(scan_message(seen.scans_m[0], stamp_ns, self._robot))
        if self._config.raw:
            self._camera_raw.put(raw(image, stamp_ns))
        else:
            self._camera.put(compress(image, stamp_ns))

    def _measure(self) -> JsonObject:
        """Ground truth, which evaluation alone reads; a clearance out of reach is null."""
        backend = self._world.backend
        poses = backend.poses
        moved = relative(self._last_poses, poses)[0]
        clearance = float(backend.clearance_m[0])
        return {
            "stamp_ns": self._stamp_ns,
            "pose": poses[0].tolist(),
            "speed_mps": float(moved[0]) / STEP_S,
            "yaw_rate_rad_s": float(moved[2]) / STEP_S,
            "clearance_m": clearance if math.isfinite(clearance) else None,
            "collided": bool(backend.collided[0]),
        }

    def _advance(self, speed_mps: float, yaw_rate_rad_s: float) -> None:
        backend = self._world.backend
        self._last_poses = backend.poses
        backend.step(np.array([speed_mps]), np.array([yaw_rate_rad_s]))
        self._tick()

    def _tick(self) -> None:
        self._stamp_ns += STEP_NS
        self._steps += 1

    def _newest_command(self) -> tuple[float, float]:
        """Speed and yaw rate to obey now: zero without a readable command in the last 0.3 s."""
        if self._unstamped is not None:
            bare = self._unstamped.get()
            twist = bare.message if bare else None
            received_s = bare.received_s if bare else -math.inf
        else:
            assert self._stamped is not None
            stamped = self._stamped.get()
            twist = stamped.message.twist if stamped and stamped.message else None
            received_s = stamped.received_s if stamped else -math.inf
        if twist is None or time.monotonic() - received_s > DEADMAN_S:
            return 0.0, 0.0
        return twist.speed_mps, twist.yaw_rate_rad_s

    def _await_answer(self, seen: Observation) -> tuple[float, float] | None:
        """The command stamped for this frame; None if something else is due first."""
        assert self._stamped is not None
        count = 0
        patience_s = REPUBLISH_S if self._unanswered < ABANDONED else 0.0
        due_s = time.monotonic() + patience_s
        while not self._ending() and self._requests.empty():
            received = self._stamped.wait(after=count, timeout_s=POLL_S)
            if received is not None:
                count = received.count
                command = received.message
                if command is not None and command.stamp_ns == self._stamp_ns:
                    self._unanswered = 0
                    return command.twist.speed_mps, command.twist.yaw_rate_rad_s
            now_s = time.monotonic()
            if now_s > due_s:
                due_s = now_s + REPUBLISH_S
                self._unanswered += 1
                if self._unanswered >= ABANDONED and abs(self._truth["speed_mps"]) > CALM_MPS:
                    logger.warning("no command answers the frames: the robot brakes")
                    return 0.0, 0.0
                self._send(seen, with_info=True)
        return None

    def _queued(self, handler: Handler) -> Handler:
        """Let the loop's own thread answer a call, between two steps."""

        def answer(request: JsonObject) -> JsonObject:
            if self._exiting.is_set():
                raise LinkError("the simulator is ending")
            future: Future[JsonObject] = Future()
            self._requests.put((handler, request, future))
            return future.result(REQUEST_PATIENCE_S)

        return answer

    def _serve(self) -> bool:
        """Answer the calls that wait; whether there was one."""
        served = False
        while not self._requests.empty():
            handler, request, future = self._requests.get()
            try:
                future.set_result(handler(request))
            except CbeError as error:
                future.set_exception(error)
            served = True
        return served

    def _refuse_requests(self) -> None:
        while not self._requests.empty():
            self._requests.get()[2].set_exception(LinkError("the simulator is ending"))

    def _reset(self, request: JsonObject) -> JsonObject:
        self._place(_numbers(request, "pose", (3,)))
        return self._truth

    def _place(self, pose: NDArray[np.float64]) -> None:
        self._world.backend.reset(pose[None])
        self._last_poses = pose[None]
        self._tick()  # no command for an older frame counts
        self._truth = self._measure()

    def _obstacle(self, request: JsonObject) -> JsonObject:
        self._world.place_bin(_numbers(request, "pose", (3,)))
        return {}

    def _drive(self, request: JsonObject) -> JsonObject:
        """Drive a demonstration in lock-step from the inside, publishing every step."""
        if "path" in request:
            path = _numbers(request, "path", (-1, 2))
            self._place(start_pose(path))
        else:
            goal = _numbers(request, "goal", (2,))
            path = plan(self._world.planning, self._world.backend.poses[0, :2], goal)
        driver = Driver(path, self._robot)
        poses, first_ns, clearance_m, reason = [], self._stamp_ns, math.inf, "timeout"
        for _ in range(driver.patience_steps):
            due_s = time.monotonic() + DRIVE_PERIOD_S
            seen = self._publish()
            poses.append(self._truth["pose"])
            clearance_m = min(clearance_m, self._truth["clearance_m"] or math.inf)
            twist = driver.command(self._world.backend.poses, seen)
            if twist is None or self._truth["collided"]:
                reason = "arrived" if twist is None else "collision"
                break
            if self._ending():
                reason = "the simulator is ending"
                break
            self._advance(float(twist[0][0]), float(twist[1][0]))
            self._exiting.wait(max(due_s - time.monotonic(), 0.0))
        logger.info("drive ended after %d steps: %s", len(poses), reason)
        return {
            "arrived": reason == "arrived",
            "reason": reason,
            "poses": poses,
            "min_clearance_m": clearance_m if math.isfinite(clearance_m) else None,
            "stamps_ns": [first_ns, self._stamp_ns],
        }

    def _shutdown(self, _request: JsonObject) -> JsonObject:
        self._exiting.set()
        return {}


def _numbers(request: JsonObject, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Finite numbers of a request, in the given shape (-1 for two or more)."""
    try:
        values = np.array(request.get(name), np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    fits = values.ndim == len(shape) and all(
        have == want or (want == -1 and have >= 2)
        for have, want in zip(values.shape, shape, strict=True)
    )
    if not fits or not np.isfinite(values).all():
        expected = " x ".join("N" if size == -1 else str(size) for size in shape)
        raise ConfigError(f"the call needs {name!r}: {expected} finite numbers")
    return values
