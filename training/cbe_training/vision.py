"""What is read off images: features, motion between two frames, attractors and their relation.

A patch-like stem replaces the authors' 5x5 convolutions, and every frame passes through it once
(paper, Sec. III-B and III-C).
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cbe import signature
from cbe_training.config import NetworkConfig

ATTRACTOR_SHAPE = signature.ATTRACTOR_SHAPE


class Trunk(nn.Module):
    """Image to features: one 8x8 convolution of stride 4, as a patch stem."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, signature.FEATURES[0], 8, stride=4, padding=2)

    def forward(self, image: Tensor) -> Tensor:
        """(N, 64, 64, 3) uint8 RGB to (N, 32, 16, 16)."""
        x = image.permute(0, 3, 1, 2).float() / 64.0 - 2.0  # about unit variance
        return F.relu(self.stem(x))


class Pair(nn.Module):
    """Motion features of two consecutive frames.

    The first convolution over both frames' channels is a sum of two, so each frame is convolved
    once and serves as `now` and, a tick later, as `previous`.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        first, second = config.pair_channels
        self.first = nn.Conv2d(signature.FEATURES[0], 2 * first, 3, stride=2, padding=1)
        self.rest = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(first, second, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(second * 16, config.motion),
            nn.ReLU(),
        )

    def forward(self, features: Tensor, previous: Tensor) -> Tensor:
        """Features (N, 32, 16, 16) of frames and of the frames before, to (N, motion)."""
        now, _ = self.first(features).chunk(2, dim=1)
        _, before = self.first(previous).chunk(2, dim=1)
        return self.rest(now + before)

    def sequence(self, features: Tensor, batch: int) -> Tensor:
        """Features (B * T, 32, 16, 16) of whole sequences to (B * T, motion).

        The first frame is its own predecessor, as in the paper's implementation.
        """
        both = self.first(features)
        both = both.view(batch, -1, *both.shape[1:])  # (B, T, 2 * first, 8, 8)
        now, before = both.chunk(2, dim=2)
        before = torch.cat([before[:, :1], before[:, :-1]], dim=1)
        return self.rest((now + before).flatten(0, 1))


class Attractor(nn.Module):
    """Features of one frame to 400 numbers in [0, 1], bounded so that they quantise evenly.

    They are 8 channels of 5 rows and 10 columns: turning the robot shifts the columns.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width = config.attractor_channels
        self.layers = nn.Sequential(
            nn.Conv2d(signature.FEATURES[0], width, 3, stride=(2, 1), padding=1),
            nn.ReLU(),
            nn.Conv2d(width, ATTRACTOR_SHAPE[0], (4, 7)),
        )

    def forward(self, features: Tensor) -> Tensor:
        """(N, 32, 16, 16) to (N, 400)."""
        return torch.sigmoid(self.layers(features)).flatten(1)


class Relation(nn.Module):
    """Where one attractor's view lies relative to another's (paper: attractor pairs).

    Every column of one view is matched with every column of the other. A turn shows as a shifted
    diagonal of that table and a move as a bent one, which a small convolution can read.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        channels, rows, columns = ATTRACTOR_SHAPE
        first, second = config.relation_channels
        self.now = nn.Linear(channels * rows, first)
        self.target = nn.Linear(channels * rows, first, bias=False)
        self.match = nn.Linear(3 * rows - 2, first, bias=False)
        self.layers = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(first, second, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(second * (columns // 2) ** 2, config.relation),
            nn.ReLU(),
        )

    def forward(self, now: Tensor, target: Tensor) -> Tensor:
        """Attractors (N, 400) twice, to (N, relation)."""
        return self.layers(self.table(now, target))

    def table(self, now: Tensor, target: Tensor) -> Tensor:
        """Attractors (N, 400) twice, to the table (N, first, 10 of now, 10 of target).

        It is affine in each; a column of `now` enters its own row alone.
        """
        now = 2.0 * now.view(-1, *ATTRACTOR_SHAPE) - 1.0
        target = 2.0 * target.view(-1, *ATTRACTOR_SHAPE) - 1.0
        one, other = now.permute(0, 2, 3, 1), target.permute(0, 2, 1, 3)
        # Each row with the same one and, since things grow as one comes near, its neighbours.
        rows = [one @ other, one[:, 1:] @ other[:, :-1], one[:, :-1] @ other[:, 1:]]
        match = torch.cat(rows, dim=1) / ATTRACTOR_SHAPE[0] ** 0.5  # (N, 13, 10, 10)
        table = self.match(match.permute(0, 2, 3, 1))  # (N, 10 now, 10 target, first)
        table = table + self.now(now.permute(0, 3, 1, 2).flatten(2))[:, :, None]
        table = table + self.target(target.permute(0, 3, 1, 2).flatten(2))[:, None]
        return table.permute(0, 3, 1, 2)
