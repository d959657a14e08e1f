"""What two makers of decisions, or one and its recording, have in common over a drive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from cbe_runtime.decisionlog import differing

if TYPE_CHECKING:
    from cbe_runtime.decision import Decision
    from cbe_runtime.retrace import Moment, Retraced


@dataclass(frozen=True, slots=True)
class Tolerance:
    """By how much two models may differ before it is worth a word; states never may."""

    waypoint_m: float = 0.05
    progress: float = 0.02


@dataclass(frozen=True, slots=True)
class Difference:
    """The first field in which a step's decision came out differently."""

    step: int
    field: str
    recorded: Any
    made: Any


class Comparison:
    """Collects the steps of a replay; without a `tolerance` every bit counts."""

    def __init__(self, tolerance: Tolerance | None = None) -> None:
        self._tolerance = tolerance
        self._begun: Moment | None = None
        self._last: Moment | None = None
        self._runs: set[str] = set()
        self._recorded = self._compared = self._differing = self._unseen = self._gaps = 0
        self._waypoint_m = self._progress = self._speed_mps = 0.0
        self._first: tuple[Moment, Difference] | None = None

    @property
    def same(self) -> bool:
        """Whether something was compared and nothing differed."""
        return self._compared > 0 and self._differing == 0

    @property
    def first(self) -> Difference | None:
        """Where the first difference is."""
        return self._first and self._first[1]

    def add(self, retraced: Retraced) -> Difference | None:
        """Take the next step in; returns what differs in it."""
        moment, made = retraced.moment, retraced.made
        record, before = moment.record, self._last.record if self._last else None
        if before is not None and before.run == record.run and before.step + 1 != record.step:
            self._gaps += 1
        self._recorded += 1
        self._runs.add(record.run)
        self._unseen += moment.observation is None
        self._last = moment
        if made is None:
            return None
        self._begun = self._begun or moment
        self._compared += 1
        self._measure(record.decision, made)
        found = self._found(record.decision, made)
        if found is None:
            return None
        self._differing += 1
        difference = Difference(record.step, *found)
        self._first = self._first or (moment, difference)
        return difference

    def summary(self) -> str:
        """A few lines for people."""
        if self._last is None:
            return "no decision was recorded"
        lines = [f"{self._recorded} recorded decisions of {len(self._runs)} run(s)"]
        if self._gaps or self._unseen:
            lines.append(
                f"{self._gaps} gap(s), and {self._unseen} decision(s) whose frame or scan is not "
                "in the recording: each is taken up again where the next behavior begins"
            )
        if self._begun is None:
            return "; ".join([*lines, "none could be compared: no behavior begins in it"])
        begun = self._begun.record
        lines.append(
            f"compared {self._compared}, from step {begun.step} ({_clock(self._begun)}), where "
            f"{'the run' if begun.step == 1 else 'a behavior'} begins, on"
        )
        what = "beyond the tolerance" if self._tolerance else "bit for bit"
        if self._first is None:
            lines.append(f"none differs {what}" if self._tolerance else f"all are the same, {what}")
        else:
            moment, first = self._first
            lines.append(
                f"{self._differing} differ{'' if self._tolerance is None else ' ' + what}, first "
                f"step {first.step} ({_clock(moment)}, segment {moment.record.decision.segment}) "
                f"in {first.field}: recorded {first.recorded!r}, came out {first.made!r}"
            )
        if self._tolerance is not None:
            lines.append(
                f"at most {self._waypoint_m:.4f} m between waypoints, {self._progress:.4f} of "
                f"progress and {self._speed_mps:.4f} m/s of speed"
            )
        return "\n".join(lines)

    def _measure(self, recorded: Decision, made: Decision) -> None:
        if recorded.waypoint_m is not None and made.waypoint_m is not None:
            apart_m = math.dist(recorded.waypoint_m, made.waypoint_m)
            self._waypoint_m = max(self._waypoint_m, apart_m)
        if recorded.segment == made.segment:
            apart = abs(recorded.progress - made.progress)
            self._progress = max(self._progress, apart)
        self._speed_mps = max(self._speed_mps, abs(recorded.speed_mps - made.speed_mps))

    def _found(self, recorded: Decision, made: Decision) -> tuple[str, Any, Any] | None:
        if self._tolerance is None:
            return differing(recorded, made)
        for name in ("state", "reason", "segment"):
            values = getattr(recorded, name), getattr(made, name)
            if values[0] != values[1]:
                return (name, *values)
        a, b = recorded.waypoint_m, made.waypoint_m
        if (a is None) != (b is None) or (a and b and math.dist(a, b) > self._tolerance.waypoint_m):
            return "waypoint_m", a, b
        if abs(recorded.progress - made.progress) > self._tolerance.progress:
            return "progress", recorded.progress, made.progress
        return None


def _clock(moment: Moment) -> str:
    when = datetime.fromtimestamp(moment.time_ns / 1e9, UTC)
    return f"{when:%H:%M:%S}.{when.microsecond // 100_000} UTC"
