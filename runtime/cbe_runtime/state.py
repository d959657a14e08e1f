"""The follower's state machine: one enum, one update."""

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """What the follower is doing."""

    IDLE = "IDLE"
    FOLLOWING = "FOLLOWING"
    ARRIVED = "ARRIVED"
    STOPPED = "STOPPED"
    LOST = "LOST"  # stands, does not know where it is, and looks for its place
    JOINING = "JOINING"  # looks for its place, driving slowly where it seems to know it


class Reason(StrEnum):
    """Why the follower is STOPPED."""

    OPERATOR = "OPERATOR"
    STALE_CAMERA = "STALE_CAMERA"
    FROZEN_CAMERA = "FROZEN_CAMERA"
    BAD_IMAGE = "BAD_IMAGE"
    BLANK_IMAGE = "BLANK_IMAGE"  # black, white, or of one colour all over
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
    """What happened since the last update; `fault` is what is wrong at present, if anything.

    `relocalise` is a start anywhere on the route; `found` means that the robot's place is known,
    in LOST that it is suspected; `lost` that it is not, or no longer.
    """

    start: bool = False
    stop: bool = False
    fault: Reason | None = None
    arrived: bool = False
    relocalise: bool = False
    found: bool = False
    lost: bool = False


class StateMachine:
    """IDLE -> FOLLOWING -> ARRIVED, with STOPPED (reason) and LOST -> JOINING beside FOLLOWING.

    An operator's stop wins over everything, then a fault, then being lost, then arrival. A
    transient fault ends by itself; OPERATOR, MODEL_FAULT and TIMEOUT wait for a start. A robot
    that did not know where it was when it stopped goes on by looking for its place.
    """

    def __init__(self) -> None:
        self.state = State.IDLE
        self.reason: Reason | None = None
        self._placed = True  # whether STOPPED goes on to FOLLOWING, not to JOINING

    def update(self, events: Events) -> None:
        """Take the one transition that these events call for."""
        starting = events.start or events.relocalise
        match self.state:
            case State.IDLE | State.ARRIVED:
                if events.stop:
                    self._enter(State.IDLE)
                elif starting:
                    self._go(events, placed=not events.relocalise)
            case State.FOLLOWING | State.LOST | State.JOINING:
                self._update_going(events)
            case State.STOPPED:
                placed = self._placed and not events.relocalise
                if events.stop:
                    self._stop(Reason.OPERATOR, placed=self._placed)
                elif starting or (self.reason is not None and self.reason.transient):
                    self._go(events, placed=placed)

    def _update_going(self, events: Events) -> None:
        if events.stop:
            self._stop(Reason.OPERATOR, placed=self.state is State.FOLLOWING)
        elif events.relocalise or (events.start and self.state is not State.FOLLOWING):
            self._go(events, placed=not events.relocalise)
        elif events.fault is not None:
            self._stop(events.fault, placed=self.state is State.FOLLOWING)
        elif events.lost:
            self._enter(State.LOST)
        elif events.found:
            self._enter(State.JOINING if self.state is State.LOST else State.FOLLOWING)
        elif events.arrived and self.state is State.FOLLOWING:
            self._enter(State.ARRIVED)

    def _go(self, events: Events, *, placed: bool) -> None:
        if events.fault is not None:
            self._stop(events.fault, placed=placed)
        else:
            self._enter(State.FOLLOWING if placed else State.JOINING)

    def _stop(self, reason: Reason, *, placed: bool) -> None:
        self._placed = placed
        self._enter(State.STOPPED, reason)

    def _enter(self, state: State, reason: Reason | None = None) -> None:
        self.state = state
        self.reason = reason
