"""Recorded drives to learn from, beside simulated ones: cloning on what a real camera saw."""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cbe.errors import RecordingError
from cbe.robot import Robot
from cbe_training import appearance, track
from cbe_training.config import TrainConfig
from cbe_training.rollout import NEVER, Behaviors, Rollouts

VIEW = (64, 64, 3)


@dataclass(frozen=True, slots=True)
class Footage:
    """One drive: `views` (T, 64, 64, 3) uint8, one a step, seen at `poses` (T, 3)."""

    views: NDArray[np.uint8]
    poses: NDArray[np.float64]

    @classmethod
    def load(cls, path: Path) -> "Footage":
        """Read what `cbe-route frames` wrote.

        Raises:
            RecordingError: the file is missing, damaged or no footage.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                views, poses = stored["views"], stored["poses"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise RecordingError(
                f"{path} is no footage ({error}); make it with cbe-route frames"
            ) from error
        whole = views.dtype == np.uint8 and views.shape[1:] == VIEW
        if not whole or poses.shape != (len(views), 3) or not np.isfinite(poses).all():
            raise RecordingError(
                f"{path} holds views {views.dtype} {views.shape} and poses {poses.shape}; expected "
                f"uint8 (T, {VIEW[0]}, {VIEW[1]}, {VIEW[2]}) and T finite poses (T, 3)"
            )
        return cls(views, poses.astype(np.float64))


def retell(
    footage: Sequence[Footage],
    count: int,
    frames: int,
    gap: int,
    config: TrainConfig,
    rng: np.random.Generator,
) -> tuple[Behaviors, Rollouts]:
    """`count` behaviors cut from recordings, and `config.repeats` repetitions of each.

    A repetition is the same stretch through another camera, its frames taken up to `gap` - 1
    steps later: nobody drove it again. The behaviors are shorter than `frames` where the
    recordings are.
    """
    longest = max(len(each.views) for each in footage)
    frames = min(frames, (longest - gap) // gap)
    steps = (frames - 1) * gap + 1
    enough = [each for each in footage if len(each.views) >= steps + gap]
    chosen = [enough[i] for i in rng.integers(0, len(enough), count)]
    first = [int(rng.integers(0, len(each.views) - steps - gap + 2)) for each in chosen]
    pieces = [each.poses[at : at + steps] for each, at in zip(chosen, first, strict=True)]
    paths = track.Paths.build(pieces)
    cameras = appearance.sample(rng, count, Robot().camera_height_m)

    def film(views: list[NDArray[np.uint8]], through: appearance.Appearance) -> NDArray[np.uint8]:
        every = np.repeat(np.arange(len(views)), frames)
        seen = appearance.apply(through.take(every), np.concatenate(views), rng)
        return seen.reshape(len(views), frames, *VIEW)

    rows = np.arange(count)
    shown = [each.views[at : at + steps : gap] for each, at in zip(chosen, first, strict=True)]
    images = film(shown, cameras)
    behaviors = Behaviors(paths, rows, cameras, images, paths.poses[:, ::gap], gap, 1)
    driven = np.repeat(rows, config.repeats)
    late = rng.integers(0, gap, len(driven))
    again = [
        (chosen[row], slice(first[row] + by, first[row] + by + steps, gap))
        for row, by in zip(driven.tolist(), late.tolist(), strict=True)
    ]
    poses = np.stack([each.poses[span] for each, span in again])
    views = [each.views[span] for each, span in again]
    seen = film(views, appearance.vary(rng, cameras.take(driven)))
    waypoints, progress = np.zeros((*poses.shape[:2], 2)), np.zeros(poses.shape[:2])
    last = np.zeros(len(driven), np.int64)
    taken = paths.take(driven)
    for tick in range(frames):
        labels = track.label(taken, poses[:, tick], last, config.lookahead_m)
        last = labels.closest
        waypoints[:, tick], progress[:, tick] = labels.waypoint_m, labels.progress
    none = np.zeros(len(driven), np.bool_)
    return behaviors, Rollouts(
        images=seen,
        poses=poses,
        waypoint_m=waypoints.astype(np.float32),
        progress=progress.astype(np.float32),
        on_route=np.ones(poses.shape[:2], np.bool_),
        frames=np.full(len(driven), frames),
        shown=driven,
        driven=driven,
        goals=paths.goals[driven],
        starts=paths.poses[driven, 0],
        carried=np.full(len(driven), NEVER),
        arrived=none,
        collided=none,
        success=none,
    )
