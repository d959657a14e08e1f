"""Where a robot is along a demonstrated path, and the labels that follow from it."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from cbe import geometry, signature

SEARCH_BACK, SEARCH_AHEAD = 6, 20  # samples round the last closest one: self-crossing drives


@dataclass(frozen=True, slots=True)
class Paths:
    """B demonstrated behaviors sampled every step, padded with their last pose."""

    poses: NDArray[np.float64]  # (B, L, 3)
    arc_m: NDArray[np.float64]  # (B, L) arc length since the start
    length: NDArray[np.int64]  # (B,) samples in use

    @classmethod
    def build(cls, pieces: list[NDArray[np.float64]]) -> "Paths":
        """From pose arrays (L_i, 3)."""
        longest = max(len(piece) for piece in pieces)
        poses = np.stack(
            [np.concatenate([p, np.repeat(p[-1:], longest - len(p), axis=0)]) for p in pieces]
        )
        steps = np.linalg.norm(np.diff(poses[..., :2], axis=1), axis=-1)
        arc = np.concatenate([np.zeros((len(pieces), 1)), np.cumsum(steps, axis=1)], axis=1)
        return cls(poses, arc, np.array([len(piece) for piece in pieces], dtype=np.int64))

    def take(self, index: NDArray[np.intp]) -> "Paths":
        """Rows `index`."""
        return Paths(self.poses[index], self.arc_m[index], self.length[index])

    @property
    def total_m(self) -> NDArray[np.float64]:
        """Arc length of each behavior, (B,)."""
        return self.arc_m[:, -1]

    @property
    def goals(self) -> NDArray[np.float64]:
        """Last pose of each behavior, (B, 3)."""
        return self.poses[np.arange(len(self.length)), self.length - 1]


@dataclass(frozen=True, slots=True)
class Labels:
    """What the demonstration says at each robot's pose."""

    closest: NDArray[np.int64]  # (B,) sample of the path
    distance_m: NDArray[np.float64]  # (B,) to that sample
    progress: NDArray[np.float64]  # (B,) arc length there / total (paper, Sec. III-C)
    waypoint_m: NDArray[np.float64]  # (B, 2) in base_link


def label(
    paths: Paths, poses: NDArray[np.float64], last: NDArray[np.int64], lookahead_m: float
) -> Labels:
    """Labels at world poses (B, 3), searched near the samples `last` (B,)."""
    closest, distance, target = _closest(
        paths.poses, paths.arc_m, paths.length, poses, last, lookahead_m, signature.OVERRUN_M
    )
    progress = paths.arc_m[np.arange(len(closest)), closest] / np.maximum(paths.total_m, 1e-6)
    return Labels(closest, distance, progress, geometry.to_frame(poses, target))


@numba.njit(cache=True)
def _closest(path, arc, length, poses, last, lookahead, overrun):  # type: ignore[no-untyped-def]
    count = len(poses)
    closest = np.empty(count, np.int64)
    distance = np.empty(count)
    target = np.empty((count, 2))
    for b in range(count):
        begin = max(last[b] - SEARCH_BACK, 0)
        end = min(last[b] + SEARCH_AHEAD + 1, length[b])
        best, best_i = np.inf, begin
        for i in range(begin, end):
            d = (path[b, i, 0] - poses[b, 0]) ** 2 + (path[b, i, 1] - poses[b, 1]) ** 2
            if d < best:
                best, best_i = d, i
        closest[b] = best_i
        distance[b] = np.sqrt(best)
        wanted = arc[b, best_i] + lookahead
        i = best_i
        while i < length[b] - 1 and arc[b, i] < wanted:
            i += 1
        target[b, 0], target[b, 1] = path[b, i, 0], path[b, i, 1]
        if i > 0 and arc[b, i] > wanted:
            share = (wanted - arc[b, i - 1]) / (arc[b, i] - arc[b, i - 1])
            for k in range(2):
                target[b, k] = path[b, i - 1, k] + share * (path[b, i, k] - path[b, i - 1, k])
        elif arc[b, i] < wanted:  # the path runs on straight, so that the robot arrives aligned
            beyond = min(wanted - arc[b, i], overrun)
            target[b, 0] += beyond * np.cos(path[b, i, 2])
            target[b, 1] += beyond * np.sin(path[b, i, 2])
    return closest, distance, target
