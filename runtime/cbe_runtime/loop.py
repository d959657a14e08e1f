"""Drives the robot at 10 Hz: receive, step, publish, wait; whatever happens, it ends stopped."""

from __future__ import annotations

import logging
import math
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cbe import topics
from cbe.errors import LinkError
from cbe.messages import Twist, TwistStamped
from cbe.robot import STEP_S
from cbe_runtime import systemd
from cbe_runtime.pace import LockStep, Pace, Ratekeeper
from cbe_runtime.state import State
from cbe_runtime.timing import Durations

if TYPE_CHECKING:
    from threading import Event

    from cbe.link import Link
    from cbe_runtime.follower import Decision, Follower
    from cbe_runtime.observation import Observation
    from cbe_runtime.sensors import Sensors

logger = logging.getLogger(__name__)

EXIT_ARRIVED = 0
EXIT_STOPPED = 3
LAST_STOPS = 3
"""Stop commands sent on the way out; any one of them will do."""
REST_TICKS = 5
"""Ticks at zero speed after which an arrived robot surely stands."""


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """How the loop runs.

    `lockstep` ticks on a simulator's frames in place of the clock; `unstamped` sends Twist in
    place of TwistStamped; `exit_when_done` ends the process on arrival, or once the robot was
    stopped for `patience_s`.
    """

    lockstep: bool = False
    unstamped: bool = False
    exit_when_done: bool = False
    patience_s: float = 5.0
    lockstep_patience_s: float = 2.5


class Loop:
    """One follower on one link."""

    def __init__(
        self,
        link: Link,
        follower: Follower,
        sensors: Sensors,
        config: LoopConfig,
        exiting: Event,
    ) -> None:
        """Declare what is published and served; `exiting` ends the loop when set."""
        self._follower = follower
        self._sensors = sensors
        self._config = config
        self._exiting = exiting
        self._stamped = None if config.unstamped else link.publisher(topics.CMD_VEL)
        self._bare = link.publisher(topics.CMD_VEL_UNSTAMPED) if config.unstamped else None
        self._statuses = link.json_publisher("status")
        self._pace: Pace = Ratekeeper(STEP_S, exiting)
        if config.lockstep:
            self._pace = LockStep(sensors, exiting, self._repeat, config.lockstep_patience_s)
        self._ticks = Durations()
        self._camera_to_command = Durations()
        self._status: dict[str, Any] = {}
        self._stamp_ns = 0
        self._twist = Twist()
        self._received_s = -math.inf
        self._began_s = 0.0
        self._rested = 0
        self._stopped_since_s: float | None = None
        self._ready = False
        self._exit_code = 0
        link.serve("start", self._on_start)
        link.serve("stop", self._on_stop)
        link.serve("status", lambda _request: self._status)
        link.declare_alive("runtime")

    def run(self) -> int:
        """Tick until told to exit; returns the process's exit code."""
        try:
            while not self._exiting.is_set():
                observation = self._receive()
                decision = self._step(observation)
                self._publish(observation, decision)
                self._wait(observation)
        finally:
            self._halt()
        return self._exit_code

    def _receive(self) -> Observation:
        self._began_s = time.monotonic()
        return self._sensors.observe()

    def _step(self, observation: Observation) -> Decision:
        decision = self._follower.step(observation, time.monotonic())
        self._judge_done(decision)
        return decision

    def _publish(self, observation: Observation, decision: Decision) -> None:
        frame = observation.frame
        lockstep = self._config.lockstep and frame is not None
        self._stamp_ns = frame.stamp_ns if lockstep and frame else time.time_ns()
        twist = Twist.planar(decision.speed_mps, decision.yaw_rate_rad_s)
        # An idle follower leaves the robot to others, once it has let go of it.
        if decision.state is not State.IDLE or twist != self._twist:
            self._command(twist)
        self._twist = twist
        now_s = time.monotonic()
        if frame is not None and frame.received_s > self._received_s:
            self._camera_to_command.add(now_s - frame.received_s)
            self._received_s = frame.received_s
        self._ticks.add(now_s - self._began_s)
        self._status = self._described(decision)
        self._statuses.put(self._status)
        if not self._ready:
            systemd.notify("READY=1")
            self._ready = True

    def _wait(self, observation: Observation) -> None:
        self._pace.wait(observation)

    def _command(self, twist: Twist) -> None:
        if self._stamped is not None:
            self._stamped.put(TwistStamped(self._stamp_ns, "base_link", twist))
        if self._bare is not None:
            self._bare.put(twist)

    def _repeat(self) -> None:
        """Send the last command again, with its stamp."""
        self._command(self._twist)

    def _halt(self) -> None:
        """The last word is always a stop."""
        with suppress(LinkError):
            for _ in range(LAST_STOPS):
                self._command(Twist())
            if self._status:
                self._statuses.put(self._status | {"state": "EXITED"})

    def _judge_done(self, decision: Decision) -> None:
        """Set the exit code and the exit, where the robot is done and it was asked for."""
        arrived = decision.state is State.ARRIVED and decision.standing
        self._rested = self._rested + 1 if arrived else 0
        if decision.state is State.STOPPED:
            now_s = time.monotonic()
            self._stopped_since_s = self._stopped_since_s or now_s
            stopped_s = now_s - self._stopped_since_s
        else:
            self._stopped_since_s, stopped_s = None, 0.0
        if not self._config.exit_when_done:
            return
        if self._rested >= REST_TICKS:
            logger.info("arrived")
            self._exit_code = EXIT_ARRIVED
            self._exiting.set()
        elif stopped_s > self._config.patience_s:
            logger.error("stopped: %s", decision.reason)
            self._exit_code = EXIT_STOPPED
            self._exiting.set()

    def _described(self, decision: Decision) -> dict[str, Any]:
        """The status object; ages are null where nothing was received."""
        return {
            "state": decision.state.value,
            "reason": decision.reason.value if decision.reason else None,
            "segment": decision.segment,
            "segments": decision.segments,
            "progress": round(decision.progress, 4),
            "on_route": round(decision.on_route, 4),
            "waypoint_m": decision.waypoint_m,
            "speed_mps": decision.speed_mps,
            "yaw_rate_rad_s": decision.yaw_rate_rad_s,
            "standing": decision.standing,
            "camera_age_s": _known(decision.camera_age_s),
            "scan_age_s": _known(decision.scan_age_s),
            "tick_ms": self._ticks.summary(),
            "camera_to_command_ms": self._camera_to_command.summary(),
            "drops": self._sensors.drops(),
            "overruns": self._pace.overruns,
            "model_id": self._follower.model_id,
        }

    def _on_start(self, _request: dict[str, Any]) -> dict[str, Any]:
        self._follower.start()
        return {"accepted": True}

    def _on_stop(self, _request: dict[str, Any]) -> dict[str, Any]:
        self._follower.stop()
        return {"accepted": True}


def _known(age_s: float) -> float | None:
    return round(age_s, 4) if math.isfinite(age_s) else None
