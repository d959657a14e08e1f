"""The path driven so far, dead-reckoned and summed up in a few numbers.

The steps read off the frames add up to a pose, and the poses' path is kept as its projection on
Legendre polynomials over the time gone by (as in HiPPO, Gu et al. 2020, measure LegS): a network
need not learn either, and later another one can lay the whole path out again (`layout`).
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial import legendre
from torch import Tensor

DEGREES = 8
LONGEST = 256
"""Frames after which the oldest fade instead of staying exact: 51 s at the runtime's rate."""
PLACE, PLACE_M = 4, 3.0
QUARTERS = 0.5 * math.pi * torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
"""Phases by which the cosine becomes a rotation: cos, sin; -sin, cos."""


class Path(NamedTuple):
    """What is carried from frame to frame."""

    pose: Tensor  # (B, 3) since the first frame
    series: Tensor  # (B, 2, DEGREES) Legendre coefficients of x and y in m
    frames: Tensor  # (B, 1) seen so far

    @classmethod
    def begin(cls, like: Tensor) -> "Path":
        """Of B robots before their first frame; device and B are those of `like` (B, ...)."""
        batch = len(like)
        return cls(
            like.new_zeros(batch, 3), like.new_zeros(batch, 2, DEGREES), like.new_zeros(batch, 1)
        )


def add_up(steps: Tensor) -> Tensor:
    """Poses (B, T, 3) after each of `steps` (B, T, 3), which are relative to the one before."""
    yaw = steps[..., 2].cumsum(dim=1)
    moved = _turn(steps, yaw - steps[..., 2]).cumsum(dim=1)
    return torch.cat([moved, yaw[..., None]], dim=-1)


def _turn(steps: Tensor, yaw: Tensor) -> Tensor:
    """Moves (..., 2) of `steps` (..., 3) as seen from where `yaw` (...) is 0."""
    rotation = (yaw[..., None, None] + QUARTERS.to(yaw)).cos()  # (..., 2, 2), of row vectors
    return (steps[..., None, :2] @ rotation).squeeze(-2)


def place(pose: Tensor) -> Tensor:
    """Poses (..., 3) as a network likes them: (..., 4) of unit size, with cosine and sine."""
    turn = (pose[..., 2:] + QUARTERS[0].to(pose)).cos()
    return torch.cat([pose[..., :2] / PLACE_M, turn], dim=-1)


def follow(poses: Tensor) -> Tensor:
    """Series (B, T, 2, DEGREES) after each of a behavior's poses (B, T, 3), the first at rest."""
    weights = _FROM_START[: poses.shape[1], : poses.shape[1]].to(poses)
    return torch.einsum("tin,bic->btcn", weights, _between(poses))


def advance(path: Path, step: Tensor) -> Path:
    """The path one `step` (B, 3) on."""
    frame = path.frames.clamp(max=LONGEST - 1).long().squeeze(-1)  # (B,)
    moved = _turn(step, path.pose[:, 2])
    pose = path.pose + torch.cat([moved, step[:, 2:]], dim=-1)
    point = path.pose[:, :2] + 0.5 * moved
    weights = RECURSION.to(pose).index_select(0, frame).unflatten(-1, (DEGREES + 1, DEGREES))
    series = torch.cat([path.series, point[..., None]], dim=-1) @ weights  # (B, 2, DEGREES)
    return Path(pose, series, path.frames + 1.0)


def _between(poses: Tensor) -> Tensor:
    """Points (B, T, 2) midway between consecutive poses; the first is the start itself."""
    before = torch.cat([poses[:, :1], poses[:, :-1]], dim=1)
    return 0.5 * (before[..., :2] + poses[..., :2])


def _integrals(share: np.ndarray) -> np.ndarray:
    """Of every polynomial, times its norm, from 0 to each share of the time (..., DEGREES)."""
    values = legendre.legvander(2.0 * share - 1.0, DEGREES)
    lower = np.concatenate([-np.ones((*share.shape, 1)), values[..., :-2]], axis=-1)
    return 0.5 * (values[..., 1:] - lower)


def _from_start() -> Tensor:
    """Weights (T, T, DEGREES) of the i-th point in the series after frame t; none at frame 0."""
    time = np.arange(1, LONGEST)[:, None]
    edges = np.minimum(np.arange(LONGEST)[None] / time, 1.0)
    weights = np.zeros((LONGEST, LONGEST, DEGREES))
    weights[1:, 1:] = np.diff(_integrals(edges), axis=1)
    return torch.from_numpy(weights).float()


def _recursion() -> Tensor:
    """How the series after frame t follows from the one before and the new point."""
    nodes, weights = legendre.leggauss(DEGREES)
    norm = 2.0 * np.arange(DEGREES) + 1.0
    advance = np.zeros((LONGEST, DEGREES + 1, DEGREES))
    for frame in range(1, LONGEST):
        kept = (frame - 1) / frame  # the past shrinks to this share of the time
        then = legendre.legvander(kept * (nodes + 1.0) - 1.0, DEGREES - 1)
        before = legendre.legvander(nodes, DEGREES - 1)
        advance[frame, :-1] = norm * 0.5 * kept * np.einsum("q,qm,qn->nm", weights, then, before)
        ends = _integrals(np.array([kept, 1.0]))
        advance[frame, -1] = ends[1] - ends[0]
    return torch.from_numpy(advance.reshape(LONGEST, -1)).float()


_FROM_START = _from_start()
RECURSION = _recursion()
"""For each frame a flat matrix (DEGREES + 1, DEGREES)."""
