"""Looks a route over before it is driven: its drive replayed against it, its joints compared."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import RouteError
from cbe_runtime.behavior import Behavior
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.likeness import unlikeness
from cbe_runtime.perturb import PERTURBATIONS, as_it_is

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from cbe_runtime.networks import Networks, Prediction
    from cbe_runtime.perturb import Perturbation
    from cbe_runtime.route import Route

    Views = Sequence[NDArray[np.uint8]]

AS_IT_IS = "as_it_is"
AROUND_STEPS = 10
"""Half a metre at full speed: a joint should look different from here."""
SAME_FRAME = 0.1
"""Far above what rounding to 4 bits does to an attractor (0.016), far below another view's."""
STILL_LEVELS = 4.0
"""A pixel that varies by less, RMS in grey levels, shows no more of the place than its noise."""
END_SHARE = 0.9  # from here on the waypoint may shrink to nothing


@dataclass(frozen=True, slots=True)
class Replay:
    """A segment's own frames, as the networks read them against its memory.

    `progress_error` is the mean distance of progress from the true share of frames;
    `progress_end` the progress at the last; `done_at` the share at which the follower would go
    on, None if never; `waypoint_ahead` the share of waypoints in front of the robot, but for the
    end; `waypoint_change_m` their mean change from tick to tick; `on_route` the mean.
    """

    progress_error: float
    progress_end: float
    done_at: float | None
    waypoint_ahead: float
    waypoint_change_m: float
    on_route: float


@dataclass(frozen=True, slots=True)
class Pictures:
    """A segment's own frames, but for what the camera never covers.

    `brightness` is their mean, 0 to 255; `still` the share of pixels that hardly vary while the
    robot drives.
    """

    brightness: float
    still: float


@dataclass(frozen=True, slots=True)
class Joint:
    """An attractor of a route, RMS differences as in `likeness.unlikeness`.

    `change` is from the frames 10 steps before and after, None where these are not known: what
    hardly changes does not pin the pose. `nearest` is from the most similar other joint,
    `nearest_joint`; None if it is the only one.
    """

    joint: int
    change: float | None
    nearest: float | None
    nearest_joint: int | None


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment of a route; without `replays` (by perturbation) where the drive is not known."""

    segment: int
    steps: int
    replays: Mapping[str, Replay] = field(default_factory=dict)
    pictures: Pictures | None = None

    @property
    def plain(self) -> Replay | None:
        """The replay of the frames as they are."""
        return self.replays.get(AS_IT_IS)


@dataclass(frozen=True, slots=True)
class Findings:
    """All that was measured; `forecast` says what it means."""

    segments: tuple[Segment, ...]
    joints: tuple[Joint, ...]
    longest_steps: int  # that the model repeats well


def look_over(
    networks: Networks,
    route: Route,
    frames: Iterable[NDArray[np.uint8]] | None = None,
    perturbations: Mapping[str, Perturbation] = PERTURBATIONS,
) -> Findings:
    """Measure a route on the frames (64, 64, 3) of its drive, one a step, or without them.

    A segment of frames is held at a time.

    Raises:
        RouteError: the route was taught with another model, or not from these frames.
        ModelError: the networks put out a value that is not finite.
    """
    route.require_model(networks)
    attractors = np.stack([route.attractor(joint) for joint in range(len(route.attractors))])
    segments: list[Segment] = []
    change: list[list[float]] = [[] for _ in attractors]
    if frames is None:
        segments = [Segment(i, each.steps) for i, each in enumerate(route.segments)]
    else:
        for index, views in enumerate(_cut(route, frames)):
            _require_same(networks, attractors[index], views[0], index)
            _require_same(networks, attractors[index + 1], views[-1], index + 1)
            for joint, step in ((index, AROUND_STEPS), (index + 1, -1 - AROUND_STEPS)):
                if len(views) > AROUND_STEPS:
                    near = _attractor(networks, views[step])
                    change[joint].append(float(unlikeness(attractors[joint], near, 0)))
            segments.append(_segment(networks, route, index, views, perturbations))
    joints = tuple(
        Joint(joint, float(np.mean(each)) if each else None, *_nearest(attractors, joint))
        for joint, each in enumerate(change)
    )
    return Findings(tuple(segments), joints, networks.segment_steps)


def _segment(
    networks: Networks,
    route: Route,
    index: int,
    views: Views,
    perturbations: Mapping[str, Perturbation],
) -> Segment:
    seen = {
        name: _replay(networks, route, index, views, kind)
        for name, kind in {AS_IT_IS: as_it_is, **perturbations}.items()
    }
    steps = len(views) - 1
    shares = _steps(networks, views) / steps
    last = index + 1 == len(route.segments)
    replays = {name: _measure(each, shares, steps, last=last) for name, each in seen.items()}
    return Segment(index, steps, replays, _pictures(views))


def _pictures(views: Views) -> Pictures:
    bright = np.stack(views).max(axis=-1)  # (T, 64, 64)
    shown = bright[:, bright.any(axis=0)].astype(np.float32)  # (T, pixels)
    if shown.size == 0:
        return Pictures(0.0, 1.0)
    return Pictures(float(shown.mean()), float((shown.std(axis=0) < STILL_LEVELS).mean()))


def _cut(route: Route, frames: Iterable[NDArray[np.uint8]]) -> Iterator[Views]:
    """Each segment's frames, the joint's in both neighbours."""
    held: list[NDArray[np.uint8]] = []
    lengths = iter(route.segments)
    segment = next(lengths, None)
    count = 0
    for frame in frames:
        count += 1
        if segment is None:  # frames too many: only counted
            continue
        held.append(frame)
        if len(held) > segment.steps:
            yield held
            held = [frame]
            segment = next(lengths, None)
    if count != route.steps + 1:
        raise RouteError(
            f"the drive has {count} frames that differ, the route {route.steps + 1}: it was not "
            "taught from this drive; give its own recording, with the same --topic and --camera"
        )


def _require_same(
    networks: Networks, stored: NDArray[np.float32], view: NDArray[np.uint8], joint: int
) -> None:
    apart = float(unlikeness(stored, _attractor(networks, view), 0))
    if apart > SAME_FRAME:
        raise RouteError(
            f"the drive does not show joint {joint} of the route: they differ by {apart:.2f}, "
            f"expected at most {SAME_FRAME:.2f}; give the recording it was taught from, with the "
            "same --topic and --camera"
        )


def _attractor(networks: Networks, view: NDArray[np.uint8]) -> NDArray[np.float32]:
    features, _, _ = networks.encode(view, networks.encoder_state())
    return networks.attract(features)


def _steps(networks: Networks, views: Views) -> NDArray[np.int64]:
    """Steps of the network ticks; the last frame is seen even between two, as when teaching."""
    last = len(views) - 1
    return np.array([*range(0, last, networks.network_period), last])


def _replay(
    networks: Networks, route: Route, segment: int, views: Views, perturbation: Perturbation
) -> list[Prediction]:
    behavior = Behavior(networks, route, segment)
    return [
        behavior.tick(perturbation(views[step], step)) for step in _steps(networks, views).tolist()
    ]


def _measure(
    seen: Sequence[Prediction], shares: NDArray[np.float64], steps: int, *, last: bool
) -> Replay:
    progress = np.array([each.progress for each in seen])
    waypoints_m = np.stack([each.waypoint_m for each in seen])  # (T, 2)
    moves = np.hypot(*np.diff(waypoints_m, axis=0).T)
    return Replay(
        progress_error=float(np.abs(progress - shares).mean()),
        progress_end=float(progress[-1]),
        done_at=_done_at(seen, shares, steps, last=last),
        waypoint_ahead=float((waypoints_m[shares < END_SHARE, 0] > 0.0).mean()),
        waypoint_change_m=float(moves.mean()),
        on_route=float(np.mean([each.on_route for each in seen])),
    )


def _done_at(
    seen: Sequence[Prediction], shares: NDArray[np.float64], steps: int, *, last: bool
) -> float | None:
    """The share of the frames after which the follower would leave the segment."""
    config = FollowerConfig()
    agreeing = 0
    for prediction, share in zip(seen, shares, strict=True):
        agreeing = agreeing + 1 if config.ends(prediction, steps, last=last) else 0
        if agreeing >= config.progress_ticks:
            return float(share)
    # Standing at the end, it would go on seeing what it saw last.
    return 1.0 if agreeing else None


def _nearest(attractors: NDArray[np.float32], joint: int) -> tuple[float, int] | tuple[None, None]:
    """The most similar other joint of attractors (J, 400): how unlike it is, and which."""
    apart = unlikeness(attractors[joint], attractors)
    apart[joint] = np.inf
    other = int(apart.argmin())
    return (float(apart[other]), other) if np.isfinite(apart[other]) else (None, None)
