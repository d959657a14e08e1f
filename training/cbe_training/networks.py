"""The behavior networks: one trunk shared by encoder and attractor, and a waypoint generator.

Paper, Sec. III-B and III-C, at about a seventh of the authors' parameters: a patch-like stem
replaces their 5x5 convolutions, and every frame passes through it once.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cbe import signature


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """Layer widths; the trunk's and the attractor's shapes are fixed by `cbe.signature`."""

    pair_channels: tuple[int, int] = (64, 128)
    motion: int = 192
    encoder_state: int = 256
    attractor_channels: int = 64
    relation_channels: tuple[int, int] = (64, 96)
    relation: int = 128
    behavior: int = 128
    generator_state: int = 320
    head: int = 128


ATTRACTOR_SHAPE = signature.ATTRACTOR_SHAPE
PLACE, PLACE_M = 4, 3.0
STEP_SCALE = 5.0
State = tuple[Tensor, Tensor]  # h, c of an LSTM, each (1, B, size)


class EncoderState(NamedTuple):
    """What the encoder carries on: its LSTM's h and c (1, B, size), dead-reckoned pose (B, 3)."""

    h: Tensor
    c: Tensor
    pose: Tensor


class Generated(NamedTuple):
    """The generator's outputs over a sequence."""

    waypoint_m: Tensor  # (B, T, 2)
    progress: Tensor  # (B, T)
    on_route_logit: Tensor  # (B, T)
    state: State


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


class Encoder(nn.Module):
    """Motion features gathered by an LSTM into the embedding z (paper, Sec. III-B).

    Beside it the steps read off the features are added up to a dead-reckoned pose, which both
    the LSTM and z see: an LSTM is slow to learn that sum by itself, and never exact.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.pair = Pair(config)
        self.odometry = nn.Linear(config.motion, 3)
        self.lstm = nn.LSTM(config.motion + PLACE, config.encoder_state, batch_first=True)
        self.to_embedding = nn.Linear(config.encoder_state + PLACE, signature.EMBEDDING_SIZE)

    def forward(
        self, motion: Tensor, state: EncoderState | None = None
    ) -> tuple[Tensor, EncoderState]:
        """Motion (B, T, motion) to embeddings (B, T, 32) and the state after the last frame.

        Without a state the first frame is a behavior's first.
        """
        step = self.step(motion)
        if state is None:
            step = torch.cat([torch.zeros_like(step[:, :1]), step[:, 1:]], dim=1)
            pose = add_up(step, step.new_zeros(len(step), 3))
            hidden, (h, c) = self.lstm(torch.cat([motion, place(pose)], dim=-1))
        else:
            pose = add_up(step, state.pose)
            inputs = torch.cat([motion, place(pose)], dim=-1)
            hidden, (h, c) = self.lstm(inputs, (state.h, state.c))
        embedding = self.to_embedding(torch.cat([hidden, place(pose)], dim=-1))
        return embedding, EncoderState(h, c, pose[:, -1])

    def step(self, motion: Tensor) -> Tensor:
        """Features (..., motion) to x, y in m and yaw in rad (..., 3) in the frame before's."""
        return self.odometry(motion) / STEP_SCALE


def add_up(steps: Tensor, start: Tensor) -> Tensor:
    """Poses (B, T, 3) after each of `steps` (B, T, 3) from `start` (B, 3)."""
    turned = steps[..., 2]
    yaw = start[:, None, 2] + turned.cumsum(dim=1)
    before = yaw - turned
    cos, sin = before.cos(), before.sin()
    x = start[:, None, 0] + (cos * steps[..., 0] - sin * steps[..., 1]).cumsum(dim=1)
    y = start[:, None, 1] + (sin * steps[..., 0] + cos * steps[..., 1]).cumsum(dim=1)
    return torch.stack([x, y, yaw], dim=-1)


def place(pose: Tensor) -> Tensor:
    """Poses (..., 3) as a network likes them: (..., 4) of unit size."""
    yaw = pose[..., 2:]
    return torch.cat([pose[..., :2] / PLACE_M, yaw.cos(), yaw.sin()], dim=-1)


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
        now = 2.0 * now.view(-1, *ATTRACTOR_SHAPE) - 1.0
        target = 2.0 * target.view(-1, *ATTRACTOR_SHAPE) - 1.0
        one, other = now.permute(0, 2, 3, 1), target.permute(0, 2, 1, 3)
        # Each row with the same one and, since things grow as one comes near, its neighbours.
        rows = [one @ other, one[:, 1:] @ other[:, :-1], one[:, :-1] @ other[:, 1:]]
        match = torch.cat(rows, dim=1) / ATTRACTOR_SHAPE[0] ** 0.5  # (N, 13, 10, 10)
        table = self.match(match.permute(0, 2, 3, 1))  # (N, 10 now, 10 target, first)
        table = table + self.now(now.permute(0, 3, 1, 2).flatten(2))[:, :, None]
        table = table + self.target(target.permute(0, 3, 1, 2).flatten(2))[:, None]
        return self.layers(table.permute(0, 3, 1, 2))


class Generator(nn.Module):
    """Waypoint, progress and on-route logit from attractors and embeddings (paper, Sec. III-C)."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.relation = Relation(config)
        self.behavior = nn.Sequential(
            nn.Linear(2 * signature.EMBEDDING_SIZE, 192),
            nn.ReLU(),
            nn.Linear(192, config.behavior),
            nn.ReLU(),
        )
        inputs = 2 * config.relation + config.behavior
        self.lstm = nn.LSTM(inputs, config.generator_state, batch_first=True)
        self.head = nn.Sequential(
            nn.Linear(config.generator_state + inputs, config.head), nn.ReLU()
        )
        self.out = nn.Linear(config.head, 4)

    def forward(
        self,
        goal_relation: Tensor,
        start_relation: Tensor,
        embedding_now: Tensor,
        embedding_goal: Tensor,
        state: State | None = None,
    ) -> Generated:
        """Relations (B, T, relation), embeddings (B, T, 32); the goal's may be broadcast over T."""
        behavior = self.behavior(torch.cat([embedding_now, embedding_goal], dim=-1))
        inputs = torch.cat([goal_relation, start_relation, behavior], dim=-1)
        hidden, state = self.lstm(inputs, state)
        # The shortcut lets a reflex reach the waypoint without passing the recurrent state.
        out = self.out(self.head(torch.cat([hidden, inputs], dim=-1)))  # (B, T, 4)
        return Generated(out[..., :2], out[..., 2], out[..., 3], state)


class BehaviorNetworks(nn.Module):
    """Everything that is trained and exported; auxiliary heads live in `losses`."""

    def __init__(self, config: NetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config or NetworkConfig()
        self.trunk = Trunk()
        self.encoder = Encoder(self.config)
        self.attractor = Attractor(self.config)
        self.generator = Generator(self.config)
        self.apply(_initialise)

    def freeze_convolutions(self, frozen: bool) -> None:
        """Choose whether everything between images and what is kept of them learns."""
        for part in (self.trunk, self.encoder.pair, self.attractor):
            part.requires_grad_(not frozen)


def _initialise(module: nn.Module) -> None:
    """He initialisation: with torch's default, views differ too little for attractors to learn."""
    if isinstance(module, nn.Conv2d | nn.Linear):
        nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def quantise(attractor: Tensor, levels: Tensor) -> Tensor:
    """Round (B, 400) in [0, 1] to `levels` (B, 1) steps, gradients passing straight through.

    Rows whose level is 0 stay exact.
    """
    steps = levels.clamp(min=1)
    rounded = torch.round(attractor * steps) / steps
    return attractor + torch.where(levels > 0, rounded - attractor, 0.0).detach()
