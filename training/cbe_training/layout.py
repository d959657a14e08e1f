"""What z says of the path, as matrices: each entry is read off z (..., 32) linearly.

A pose is a homogeneous matrix (3, 3), a set of points (3, P) has a last row of ones. The paths'
columns are PATH_POINTS points at equal shares of the time, then the start itself and, with a last
row of zero, the direction the start faces.
"""

import numpy as np
import torch
from numpy.polynomial import legendre
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from cbe import signature
from cbe_training.path import DEGREES, PLACE, PLACE_M

TRACED = PLACE + 2 * DEGREES
"""Numbers of z that are read off the dead-reckoned path: pose at its end, then its series."""
PATH_POINTS = 16
SCALE = torch.tensor([1.0 / PLACE_M] * PATH_POINTS + [1.0, 1.0])
"""Of the columns, for a network's eyes."""

_X, _Y, _COS, _SIN = range(PLACE)
_Entries = dict[tuple[int, int], dict[int | None, float]]  # of matrices: weights of z, None: 1


def pose_of(embedding: Tensor) -> Tensor:
    """Pose (..., 4: x, y, cos, sin) in m at the path's end, in its first frame."""
    return torch.cat([PLACE_M * embedding[..., :2], embedding[..., 2:PLACE]], dim=-1)


def path_of(embedding: Tensor, points: int) -> Tensor:
    """Points (..., points, 2) in m at equal shares of the path's time."""
    flat = embedding @ _points(points).to(embedding)
    return flat.unflatten(-1, (2, points)).transpose(-1, -2)


def length_m(embedding: Tensor) -> Tensor:
    """Length (..., 1) of the path."""
    legs = (embedding @ _LEGS.to(embedding)).unflatten(-1, (2, PATH_POINTS))
    return torch.linalg.vector_norm(legs + 1e-6, dim=-2).sum(dim=-1, keepdim=True)


def frame(pose: Tensor) -> Tensor:
    """Matrices (..., 3, 3) of poses (..., 4: x, y, cos, sin)."""
    return F.linear(pose, FRAME[0].to(pose), FRAME[1].to(pose)).unflatten(-1, (3, 3))


def into(embedding: Tensor) -> Tensor:
    """Matrices (..., 3, 3) that bring points of the first frame into that of the path's end."""
    return _read(embedding, TURN_BACK, 3) @ _read(embedding, MOVE_BACK, 3)


def from_start(embedding: Tensor) -> Tensor:
    """The path's columns (..., 3, 18) in its first frame."""
    return _read(embedding, _COLUMNS, PATH_POINTS + 2)


def from_end(embedding: Tensor) -> Tensor:
    """The path's columns (..., 3, 18) in the frame of its end."""
    columns = _read(embedding, _COLUMNS_FROM_END, PATH_POINTS + 2)
    return _read(embedding, TURN_BACK, 3) @ columns


def _read(embedding: Tensor, matrix: tuple[Tensor, Tensor], columns: int) -> Tensor:
    weights, bias = (part.to(embedding) for part in matrix)
    return F.linear(embedding, weights, bias).unflatten(-1, (3, columns))


def _matrix(entries: _Entries, columns: int, inputs: int) -> tuple[Tensor, Tensor]:
    """Weights (3 * columns, inputs) and bias of a (3, columns) matrix with these entries."""
    weights, bias = torch.zeros(3 * columns, inputs), torch.zeros(3 * columns)
    for (row, column), terms in entries.items():
        for source, value in terms.items():
            if source is None:
                bias[row * columns + column] = value
            else:
                weights[row * columns + column, source] = value
    return weights, bias


def _basis(points: int) -> NDArray[np.float64]:
    """Legendre polynomials at equal shares of the time (points, DEGREES)."""
    shares = np.linspace(-1.0, 1.0, points + 1)[1:]
    return np.asarray(legendre.legvander(shares, DEGREES - 1), np.float64)


def _points(points: int) -> Tensor:
    """From z to all x, then all y (32, 2 * points)."""
    weights = np.zeros((signature.EMBEDDING_SIZE, 2, points))
    for axis in range(2):
        first = PLACE + axis * DEGREES
        weights[first : first + DEGREES, axis] = PLACE_M * _basis(points).T
    return torch.from_numpy(weights.reshape(len(weights), -1)).float()


def _columns(*, from_end: bool) -> tuple[Tensor, Tensor]:
    """The path's columns, relative to its start or, still unturned, to its end."""
    columns = PATH_POINTS + 2
    weights, bias = torch.zeros(3, columns, signature.EMBEDDING_SIZE), torch.zeros(3, columns)
    points = _points(PATH_POINTS).T.reshape(2, PATH_POINTS, -1)
    weights[:2, :PATH_POINTS] = points
    if from_end:
        for axis in (_X, _Y):
            weights[axis, : PATH_POINTS + 1, axis] -= PLACE_M
    bias[2, : PATH_POINTS + 1] = 1.0
    bias[0, PATH_POINTS + 1] = 1.0
    return weights.flatten(0, 1), bias.flatten()


def _legs() -> Tensor:
    points = _points(PATH_POINTS).unflatten(-1, (2, PATH_POINTS))
    return torch.cat([points[..., :1], points.diff(dim=-1)], dim=-1).flatten(-2)


_ROTATION: _Entries = {(0, 0): {_COS: 1.0}, (1, 1): {_COS: 1.0}, (2, 2): {None: 1.0}}
# Weights and bias that read the matrices off a pose (FRAME) and off z.
FRAME = _matrix(
    {**_ROTATION, (0, 1): {_SIN: -1.0}, (1, 0): {_SIN: 1.0}, (0, 2): {_X: 1.0}, (1, 2): {_Y: 1.0}},
    3,
    PLACE,
)
TURN_BACK = _matrix(
    {**_ROTATION, (0, 1): {_SIN: 1.0}, (1, 0): {_SIN: -1.0}}, 3, signature.EMBEDDING_SIZE
)
MOVE_BACK = _matrix(
    {
        **{(i, i): {None: 1.0} for i in range(3)},
        (0, 2): {_X: -PLACE_M},
        (1, 2): {_Y: -PLACE_M},
    },
    3,
    signature.EMBEDDING_SIZE,
)
_COLUMNS, _COLUMNS_FROM_END = _columns(from_end=False), _columns(from_end=True)
_LEGS = _legs()
