"""The follower's state machine: one enum, one update."""

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """What the follower is doing."""

    IDLE = "IDLE"
    FOLLOWING = "FOLLOWING"
    ARRIVED = "ARRIVED"
    STOPPED = "STOPPED"


class Reason(StrEnum):
    """Why the follower is STOPPED."""

    OPERATOR = "OPERATOR"
    STALE_CAMERA = "STALE_CAMERA"
    FROZEN_CAMERA = "FROZEN_CAMERA"
    BAD_IMAGE = "BAD_IMAGE"
    STALE_SCAN = "STALE_SCAN"
    FROZEN_SCAN = "FROZEN_SCAN"
    BAD_SCAN = "BAD_SCAN"
    MODEL_FAULT = "MODEL_FAULT"
    TIMEOUT = "TIMEOUT"

    @property
    def transient(self) -> bool:
        """Whether the follower goes on by itself once the fault is gone."""
        return self not in {Reason.OPERATOR, Reason.MODEL_FAULT, Reason.TIMEOUT}


@dataclass(frozen=True, slots=True)
class Events:
    """What happened since the last update; `fault` is what is wrong at present, if anything."""

    start: bool = False
    stop: bool = False
    fault: Reason | None = None
    arrived: bool = False


class StateMachine:
    """IDLE -> FOLLOWING -> ARRIVED, with STOPPED (reason) beside FOLLOWING.

    An operator's stop wins over everything, then a fault, then arrival. A transient fault ends
    by itself; OPERATOR, MODEL_FAULT and TIMEOUT wait for a start.
    """

    def __init__(self) -> None:
        self.state = State.IDLE
        self.reason: Reason | None = None

    def update(self, events: Events) -> None:
        """Take the one transition that these events call for."""
        match self.state:
            case State.IDLE | State.ARRIVED:
                if events.stop:
                    self._enter(State.IDLE)
                elif events.start:
                    self._follow_or_stop(events.fault)
            case State.FOLLOWING:
                if events.stop:
                    self._enter(State.STOPPED, Reason.OPERATOR)
                elif events.fault is not None:
                    self._enter(State.STOPPED, events.fault)
                elif events.arrived:
                    self._enter(State.ARRIVED)
            case State.STOPPED:
                if events.stop:
                    self._enter(State.STOPPED, Reason.OPERATOR)
                elif events.start or (self.reason is not None and self.reason.transient):
                    self._follow_or_stop(events.fault)

    def _follow_or_stop(self, fault: Reason | None) -> None:
        if fault is None:
            self._enter(State.FOLLOWING)
        else:
            self._enter(State.STOPPED, fault)

    def _enter(self, state: State, reason: Reason | None = None) -> None:
        self.state = state
        self.reason = reason
