"""Drives the robot at 10 Hz: receive, step, publish, wait; whatever happens, it ends stopped."""

from __future__ import annotations

import logging
import math
import time
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cbe import topics
from cbe.errors import ConfigError, LinkError
from cbe.messages import Twist, TwistStamped
from cbe.robot import STEP_S
from cbe_runtime.decisionlog import DecisionLog
from cbe_runtime.joining import Whereabouts
from cbe_runtime.pace import LockStep, Pace, Ratekeeper
from cbe_runtime.state import State
from cbe_runtime.systemd import Heartbeat
from cbe_runtime.timing import Timings
from cbe_runtime.watchdog import Watchdog

if TYPE_CHECKING:
    from collections.abc import Callable
    from threading import Event

    from cbe.link import Link
    from cbe_runtime.decision import Decision
    from cbe_runtime.follower import Follower
    from cbe_runtime.observation import Observation
    from cbe_runtime.sensors import Sensors

logger = logging.getLogger(__name__)

EXIT_ARRIVED = 0
EXIT_STOPPED = 3
LAST_STOPS = 3
"""Stop commands sent on the way out; any one of them will do."""
OLD_DECISION_S = 0.3
"""A decision that took this long is as old as what it saw; a stop takes its place."""
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
        watch: Callable[[Decision], None] | None = None,
    ) -> None:
        """Declare what is published and served; `exiting` ends the loop when set.

        `watch` is told every decision, and must not wait for anything.
        """
        self._watch = watch
        self._follower = follower
        self._sensors = sensors
        self._config = config
        self._exiting = exiting
        self._stamped = None if config.unstamped else link.publisher(topics.CMD_VEL)
        self._bare = link.publisher(topics.CMD_VEL_UNSTAMPED) if config.unstamped else None
        self._statuses = link.json_publisher("status")
        self._decisions = DecisionLog(link, follower, sensors)
        self._pace: Pace = Ratekeeper(STEP_S, exiting, sensors)
        if config.lockstep:
            self._pace = LockStep(sensors, exiting, self._repeat, config.lockstep_patience_s)
        self._timings = Timings()
        self._heartbeat = Heartbeat()
        self._watchdog = Watchdog(self._stop_hanging)
        self._status: dict[str, Any] = {"state": State.IDLE.value}
        self._stamp_ns = 0
        self._twist = Twist()
        self._received_s = -math.inf
        self._began_s = 0.0
        self._decided_s = 0.0
        self._rested = 0
        self._stopped_since_s: float | None = None
        self._exit_code = 0
        link.serve("start", self._on_start)
        link.serve("stop", self._on_stop)
        link.serve("relocalise", self._on_relocalise)
        link.serve("status", lambda _request: self._status)
        link.declare_alive("runtime")

    def run(self) -> int:
        """Tick until told to exit; returns the process's exit code."""
        # In lock-step a tick waits for the simulator, and may do so for long.
        with nullcontext() if self._config.lockstep else self._watchdog:
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
        self._decided_s = time.monotonic()
        decision = self._follower.step(observation, self._decided_s)
        if decision.ticked:
            self._timings.inference.add(time.monotonic() - self._decided_s)
        self._timings.jitter.add(self._pace.jitter_s)
        if observation.frame is not None:
            self._timings.camera_age.add(decision.camera_age_s)
        if observation.scan is not None:
            self._timings.scan_age.add(decision.scan_age_s)
        self._judge_done(decision)
        return decision

    def _publish(self, observation: Observation, decision: Decision) -> None:
        frame = observation.frame
        lockstep = self._config.lockstep and frame is not None
        self._stamp_ns = frame.stamp_ns if lockstep and frame else time.time_ns()
        twist = Twist.planar(decision.speed_mps, decision.yaw_rate_rad_s)
        took_s = time.monotonic() - self._began_s
        if took_s > OLD_DECISION_S and not self._config.lockstep:
            logger.warning("a decision took %.2f s; the robot is stopped instead", took_s)
            twist = Twist()
        # An idle follower leaves the robot to others, once it has let go of it.
        if decision.state is not State.IDLE or twist != self._twist:
            self._command(twist)
        self._twist = twist
        now_s = time.monotonic()
        if frame is not None and frame.received_s > self._received_s:
            self._timings.camera_to_command.add(now_s - frame.received_s)
            self._received_s = frame.received_s
        self._timings.tick.add(now_s - self._began_s)
        self._status = self._described(decision)
        self._statuses.put(self._status)
        self._decisions.put(observation, self._decided_s, decision)
        if self._watch is not None:
            self._watch(decision)
        self._heartbeat.beat()
        self._watchdog.beat(driving=twist != Twist())

    def _wait(self, observation: Observation) -> None:
        self._pace.wait(observation)

    def _command(self, twist: Twist) -> None:
        if self._stamped is not None:
            self._stamped.put(TwistStamped(self._stamp_ns, "base_link", twist))
        if self._bare is not None:
            self._bare.put(twist)

    def _stop_hanging(self) -> None:
        """Stop the robot from the watchdog's thread, and say so: the loop's own hangs."""
        self._stamp_ns = time.time_ns()
        self._command(Twist())
        stopped = {"state": State.STOPPED.value, "reason": "HUNG", "speed_mps": 0.0}
        self._statuses.put(self._status | stopped | {"hangs": self._watchdog.trips})

    def _repeat(self) -> None:
        """Send the last command again, with its stamp."""
        self._command(self._twist)

    def _halt(self) -> None:
        """The last word is always a stop."""
        with suppress(LinkError):
            for _ in range(LAST_STOPS):
                self._command(Twist())
            self._statuses.put(self._status | {"state": "EXITED"})

    def _judge_done(self, decision: Decision) -> None:
        """Set the exit code and the exit, where the robot is done and it was asked for."""
        arrived = decision.state is State.ARRIVED and decision.standing
        self._rested = self._rested + 1 if arrived else 0
        if decision.state in {State.STOPPED, State.LOST}:
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
            logger.error("stopped: %s", decision.reason or self._follower.advice)
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
            "lost": round(decision.lost, 4),
            "place": _described_place(decision.place),
            "advice": self._follower.advice,
            "waypoint_m": decision.waypoint_m,
            "speed_mps": decision.speed_mps,
            "yaw_rate_rad_s": decision.yaw_rate_rad_s,
            "standing": decision.standing,
            "camera_age_s": _known(decision.camera_age_s),
            "scan_age_s": _known(decision.scan_age_s),
            "drops": self._sensors.drops(),
            "overruns": self._pace.overruns,
            "hangs": self._watchdog.trips,
            **self._timings.status(),
            "model_id": self._follower.model_id,
        }

    def _on_start(self, _request: dict[str, Any]) -> dict[str, Any]:
        self._follower.start()
        return {"accepted": True}

    def _on_relocalise(self, request: dict[str, Any]) -> dict[str, Any]:
        """Look for the place anywhere, or near `{"segment": n}` if that is given."""
        segment = request.get("segment")
        if segment is None:
            self._follower.relocalise()
        elif type(segment) is int and 0 <= segment < self._follower.segments:
            self._follower.relocalise(Whereabouts(segment, 0.0, 0.0))
        else:
            raise ConfigError(
                f"segment {str(segment)[:20]!r} is none of the route's "
                f"{self._follower.segments}, which count from 0"
            )
        return {"accepted": True}

    def _on_stop(self, _request: dict[str, Any]) -> dict[str, Any]:
        self._follower.stop()
        return {"accepted": True}


def _described_place(place: Whereabouts | None) -> dict[str, float] | None:
    if place is None:
        return None
    return {
        "segment": place.segment,
        "progress": round(place.progress, 4),
        "confidence": round(place.confidence, 4),
    }


def _known(age_s: float) -> float | None:
    return round(age_s, 4) if math.isfinite(age_s) else None
