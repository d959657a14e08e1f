"""What a route's figures mean: flags, and how likely it is to be repeated.

The one place where figures become verdicts, so that it can be calibrated against driven routes.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from cbe_runtime.likeness import ALIKE
from cbe_runtime.lint import AS_IT_IS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cbe_runtime.lint import Findings, Joint, Replay, Segment


class Flag(StrEnum):
    """What is wrong with a segment or a joint."""

    TOO_LONG = "too_long"
    NEVER_DONE = "never_done"
    DONE_EARLY = "done_early"
    PROGRESS = "progress"
    WAYPOINT = "waypoint"
    OFF_ROUTE = "off_route"
    FRAGILE = "fragile"
    DARK = "dark"
    COVERED = "covered"
    WEAK_JOINT = "weak_joint"
    LOOK_ALIKE = "look_alike"


MEANING = {
    Flag.TOO_LONG: "longer than the model repeats well",
    Flag.NEVER_DONE: "its own last frame does not end it",
    Flag.DONE_EARLY: "it ends long before its last frame",
    Flag.PROGRESS: "progress is misread on its own frames",
    Flag.WAYPOINT: "waypoints jump, or lie behind the robot",
    Flag.OFF_ROUTE: "its own frames look off the route",
    Flag.FRAGILE: "perturbed images are misread",
    Flag.DARK: "its frames are hardly lit",
    Flag.COVERED: "much of its view never changes, as if something were before the lens",
    Flag.WEAK_JOINT: "looks the same half a metre away",
    Flag.LOOK_ALIKE: "looks like another joint",
}


@dataclass(frozen=True, slots=True)
class Limits:
    """From where on a figure is flagged."""

    progress_error: float = 0.12
    early: float = 0.8  # share of the frames
    waypoint_ahead: float = 0.9
    waypoint_change_m: float = 0.15  # a tick's travel is 0.1 m
    on_route: float = 0.5
    brightness: float = 40.0  # frames of lit validation worlds: 95 at least
    still: float = 0.5  # share of the view; 0.33 at most there
    change: float = 0.2  # of 69 joints in validation worlds a twentieth lies below
    passes: float = 0.5  # predicted success


@dataclass(frozen=True, slots=True)
class Score:
    """Predicted success of a segment: a logistic of its figures. A route needs all its segments.

    `sound` is the log odds of a segment without any error; each error costs its weight for every
    time that it fills its limit, each flag its own. Set by hand, after 180 routes of
    `cbe-bench lint --world val`, of which 92 succeeded.
    """

    sound: float = 5.0
    progress_error: float = 1.0  # of the frames as they are
    perturbed_error: float = 1.0  # mean over the perturbations
    off_route: float = 0.5
    waypoint: float = 0.5
    flags: Mapping[Flag, float] = field(
        default_factory=lambda: {
            Flag.NEVER_DONE: 1.0,
            Flag.DONE_EARLY: 1.0,
            Flag.TOO_LONG: 1.5,
            Flag.DARK: 8.0,
            Flag.COVERED: 6.0,
        }
    )


LIMITS, SCORE = Limits(), Score()


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is said of a route; flags of segments and joints in their order.

    `chances` are the segments' predicted successes and `predicted_success` the route's, both None
    where the drive is not known. `passed` is then whether nothing is flagged.
    """

    findings: Findings
    segment_flags: tuple[tuple[Flag, ...], ...]
    joint_flags: tuple[tuple[Flag, ...], ...]
    chances: tuple[float, ...] | None
    predicted_success: float | None
    passed: bool

    def to_dict(self) -> dict[str, Any]:
        """All of it as JSON can hold it."""
        chances = self.chances or (None,) * len(self.segment_flags)
        segments = zip(self.findings.segments, chances, self.segment_flags, strict=True)
        joints = zip(self.findings.joints, self.joint_flags, strict=True)
        return {
            "passed": self.passed,
            "predicted_success": self.predicted_success,
            "segments": [
                asdict(segment) | {"predicted_success": chance, "flags": list(flags)}
                for segment, chance, flags in segments
            ],
            "joints": [asdict(joint) | {"flags": list(flags)} for joint, flags in joints],
        }

    def summary(self) -> str:
        """One line."""
        counts = {
            flag: sum(flag in flags for flags in (*self.segment_flags, *self.joint_flags))
            for flag in Flag
        }
        flagged = ", ".join(f"{count} {flag}" for flag, count in counts.items() if count)
        if self.predicted_success is None:
            chance = "no prediction without the drive"
        else:
            chance = f"predicted success {100.0 * self.predicted_success:.0f} %"
        return f"{'passes' if self.passed else 'FLAGGED'}: {chance}; {flagged or 'no flags'}"

    def lines(self) -> list[str]:
        """A table for people, the summary last."""
        lines = []
        if self.chances:
            lines.append(
                "segment steps  progress error   ends  waypoint   on   predicted\n"
                "               plain perturbed    at  change m  route   success"
            )
            rows = zip(self.findings.segments, self.chances, strict=True)
            lines += [_row(segment, chance) for segment, chance in rows]
        for kind, all_flags in (("segment", self.segment_flags), ("joint", self.joint_flags)):
            for index, flags in enumerate(all_flags):
                lines += [f"{kind} {index}: {flag}: {MEANING[flag]}" for flag in flags]
        return [*lines, self.summary()]


def judge(findings: Findings, limits: Limits = LIMITS, score: Score = SCORE) -> Verdict:
    """Flag what is beyond its limit, and predict success."""
    joint_flags = tuple(_joint_flags(joint, limits) for joint in findings.joints)
    segment_flags = tuple(
        _segment_flags(segment, findings.longest_steps, limits) for segment in findings.segments
    )
    chances: list[float] = []
    for segment, flags in zip(findings.segments, segment_flags, strict=True):
        if segment.plain is not None:
            chances.append(_chance(segment, segment.plain, flags, limits, score))
    if not chances:
        return Verdict(
            findings, segment_flags, joint_flags, None, None, not any(segment_flags + joint_flags)
        )
    success = math.prod(chances)
    return Verdict(
        findings, segment_flags, joint_flags, tuple(chances), success, success >= limits.passes
    )


def _joint_flags(joint: Joint, limits: Limits) -> tuple[Flag, ...]:
    found = {
        Flag.WEAK_JOINT: joint.change is not None and joint.change < limits.change,
        Flag.LOOK_ALIKE: joint.nearest is not None and joint.nearest < ALIKE,
    }
    return tuple(flag for flag, is_so in found.items() if is_so)


def _segment_flags(segment: Segment, longest_steps: int, limits: Limits) -> tuple[Flag, ...]:
    found = {Flag.TOO_LONG: segment.steps > longest_steps}
    plain = segment.plain
    if plain is not None:
        perturbed = _perturbed_error(segment)
        found |= {
            Flag.NEVER_DONE: plain.done_at is None,
            Flag.DONE_EARLY: plain.done_at is not None and plain.done_at < limits.early,
            Flag.PROGRESS: plain.progress_error > limits.progress_error,
            Flag.WAYPOINT: _waypoint_fault(plain, limits) > 1.0,
            Flag.OFF_ROUTE: plain.on_route < limits.on_route,
            Flag.FRAGILE: perturbed > limits.progress_error,
        }
    if segment.pictures is not None:
        found |= {
            Flag.DARK: segment.pictures.brightness < limits.brightness,
            Flag.COVERED: segment.pictures.still > limits.still,
        }
    return tuple(flag for flag, is_so in found.items() if is_so)


def _chance(
    segment: Segment, plain: Replay, flags: tuple[Flag, ...], limits: Limits, score: Score
) -> float:
    odds = score.sound
    odds -= score.progress_error * plain.progress_error / limits.progress_error
    odds -= score.perturbed_error * _perturbed_error(segment) / limits.progress_error
    odds -= score.off_route * (1.0 - plain.on_route) / (1.0 - limits.on_route)
    odds -= score.waypoint * _waypoint_fault(plain, limits)
    odds -= sum(score.flags.get(flag, 0.0) for flag in flags)
    return 1.0 / (1.0 + math.exp(-odds))


def _perturbed_error(segment: Segment) -> float:
    """Mean progress error over the perturbations; of the plain frames where there are none."""
    perturbed = [each for name, each in segment.replays.items() if name != AS_IT_IS]
    errors = [each.progress_error for each in perturbed or segment.replays.values()]
    return sum(errors) / len(errors)


def _waypoint_fault(plain: Replay, limits: Limits) -> float:
    """The worse of two faults, 1 at its limit."""
    behind = (1.0 - plain.waypoint_ahead) / (1.0 - limits.waypoint_ahead)
    return max(behind, plain.waypoint_change_m / limits.waypoint_change_m)


def _row(segment: Segment, chance: float) -> str:
    plain = segment.plain
    assert plain is not None
    ends = "never" if plain.done_at is None else f"{100.0 * plain.done_at:.0f} %"
    return (
        f"{segment.segment:7d} {segment.steps:5d} {plain.progress_error:8.3f} "
        f"{_perturbed_error(segment):9.3f} {ends:>6} {plain.waypoint_change_m:9.3f} "
        f"{plain.on_route:6.2f} {100.0 * chance:8.0f} %"
    )
