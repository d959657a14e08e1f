"""The behavior networks: encoder, attractor and waypoint generator on one trunk.

Paper, Sec. III-B and III-C, at a twentieth of the authors' parameters.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cbe import signature
from cbe_training import layout, path
from cbe_training.config import NetworkConfig
from cbe_training.layout import PATH_POINTS, TRACED
from cbe_training.path import PLACE, PLACE_M, Path, place
from cbe_training.vision import Attractor, Pair, Relation, Trunk

STEP_SCALE = 5.0
State = tuple[Tensor, Tensor]  # h, c of an LSTM, each (1, B, size)


class EncoderState(NamedTuple):
    """What the encoder carries on: its LSTM's h and c (1, B, size), and the path."""

    h: Tensor
    c: Tensor
    path: Path


class Generated(NamedTuple):
    """The generator's outputs over a sequence."""

    waypoint_m: Tensor  # (B, T, 2)
    progress: Tensor  # (B, T)
    on_route_logit: Tensor  # (B, T)
    state: State


class Encoder(nn.Module):
    """Motion features gathered by an LSTM into the embedding z (paper, Sec. III-B).

    The steps read off the features are added up beside it. What z says of the path comes from
    there: an LSTM is slow to learn such a sum by itself, and never exact.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.pair = Pair(config)
        self.odometry = nn.Sequential(nn.Linear(config.motion, 128), nn.ReLU(), nn.Linear(128, 3))
        self.lstm = nn.LSTM(config.motion + PLACE, config.encoder_state, batch_first=True)
        self.to_embedding = nn.Linear(
            config.encoder_state + TRACED, signature.EMBEDDING_SIZE - TRACED
        )

    def forward(
        self, motion: Tensor, state: EncoderState | None = None
    ) -> tuple[Tensor, EncoderState]:
        """Motion (B, T, motion) to embeddings (B, T, 32) and the state after the last frame.

        Without a state the first frame is a behavior's first; with one, T is 1.
        """
        step = self.step(motion)
        if state is None:
            step = torch.cat([torch.zeros_like(step[:, :1]), step[:, 1:]], dim=1)
            pose = path.add_up(step)
            series = path.follow(pose)
            frames = step.new_full((len(step), 1), step.shape[1])
            after = Path(pose[:, -1], series[:, -1], frames)
            hidden, (h, c) = self.lstm(torch.cat([motion, place(pose)], dim=-1))
        else:
            after = path.advance(state.path, step[:, -1])
            pose, series = after.pose[:, None], after.series[:, None]
            inputs = torch.cat([motion, place(pose)], dim=-1)
            hidden, (h, c) = self.lstm(inputs, (state.h, state.c))
        return self.embed(hidden, pose, series), EncoderState(h, c, after)

    def step(self, motion: Tensor) -> Tensor:
        """Features (..., motion) to x, y in m and yaw in rad (..., 3) in the frame before's."""
        return self.odometry(motion) / STEP_SCALE

    def embed(self, hidden: Tensor, pose: Tensor, series: Tensor) -> Tensor:
        """LSTM output, pose (..., 3) and path (..., 2, DEGREES) to z (..., 32)."""
        traced = torch.cat([place(pose), series.flatten(-2) / PLACE_M], dim=-1)
        return torch.cat([traced, self.to_embedding(torch.cat([hidden, traced], dim=-1))], dim=-1)


class Remembered(NamedTuple):
    """What stays the same while a behavior is repeated, so that a tick need not work it out."""

    start_relation: Tensor  # (B, T or 1, relation)
    columns: Tensor  # (B, T or 1, 2, 3, 18) the path's, in the first frame and from its end
    stride: Tensor  # (B, T or 1, 1) share of the path that a lookahead takes
    behavior: Tensor  # (B, T or 1, 192) what z adds to the first layer that reads it


class Guide(nn.Module):
    """Where the remembered path lies from here, and where that says to go.

    It is laid out twice: from the start, by dead reckoning, and from the goal, by its view. The
    first drifts and the second needs the goal in sight; what comes after weighs them.

    All is products of homogeneous matrices (3, 3) with columns (3, P), each read off z linearly.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.locate = nn.Sequential(
            nn.Linear(config.relation, 128), nn.ReLU(), nn.Linear(128, PLACE)
        )
        self.nearness_m = nn.Parameter(torch.tensor(0.2))
        layouts = 2 * (2 * len(layout.SCALE) + 3)
        self.layers = nn.Sequential(
            nn.Linear(layouts + PLACE, 128), nn.ReLU(), nn.Linear(128, config.guide), nn.ReLU()
        )
        self.size = config.guide + 6

    def remember(self, start_relation: Tensor, embedding_goal: Tensor) -> tuple[Tensor, Tensor]:
        """`Remembered.columns` and `.stride`."""
        start = layout.frame(self.seen(start_relation))
        columns = layout.from_start(embedding_goal), layout.from_end(embedding_goal)
        length_m = layout.length_m(embedding_goal)
        stride = signature.LOOKAHEAD_M / (length_m + signature.LOOKAHEAD_M)
        return torch.stack([start @ columns[0], columns[1]], dim=-3), stride

    def forward(
        self, goal_relation: Tensor, embedding_now: Tensor, columns: Tensor, stride: Tensor
    ) -> Tensor:
        """As `Generator.forward`, to (B, T, size)."""
        goal = self.seen(goal_relation)
        frames = torch.stack([layout.into(embedding_now), layout.frame(goal)], dim=-3)
        laid = frames[..., :2, :] @ columns  # (B, T, 2, 2, 18)
        ahead, share = self._ahead(laid[..., :PATH_POINTS], stride)
        scaled = (laid * layout.SCALE.to(laid)).flatten(-2)
        reasons = torch.cat([scaled, ahead, share], dim=-1).flatten(-2)
        read = self.layers(torch.cat([reasons, goal], dim=-1))
        return torch.cat([read, ahead.flatten(-2), share.flatten(-2)], dim=-1)

    def seen(self, relation: Tensor) -> Tensor:
        """Pose (..., 4: x, y, cos, sin) that a relation shows: of the goal, or of the start."""
        x_y, turn = self.locate(relation).split(2, dim=-1)
        norm = torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
        return torch.cat([x_y, turn / (norm + 0.01)], dim=-1)

    def _ahead(self, points: Tensor, stride: Tensor) -> tuple[Tensor, Tensor]:
        """The point (..., 2) a lookahead on from the nearest of (..., 2, P), and that one's share.

        All softly, so that gradients pass.
        """
        shares = torch.arange(1, PATH_POINTS + 1).to(points) / PATH_POINTS
        near = (points * points).sum(dim=-2) * -(self.nearness_m**-2)
        share = near.softmax(dim=-1) @ shares[:, None]
        there = share + stride[..., None]
        weights = (-((PATH_POINTS * (shares - there)) ** 2)).softmax(dim=-1)
        return (points @ weights[..., None]).squeeze(-1), share


class Generator(nn.Module):
    """Waypoint, progress and on-route logit from attractors and embeddings (paper, Sec. III-C)."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.relation = Relation(config)
        self.guide = Guide(config)
        self.behavior = nn.Sequential(
            nn.Linear(2 * signature.EMBEDDING_SIZE, 192),
            nn.ReLU(),
            nn.Linear(192, config.behavior),
            nn.ReLU(),
        )
        inputs = 2 * config.relation + config.behavior + self.guide.size
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
        """Relations (B, T, relation), embeddings (B, T, 32); of start and goal one may do for T."""
        remembered = self.remember(start_relation, embedding_goal)
        inputs = self.gather(goal_relation, embedding_now, remembered)
        hidden, state = self.lstm(inputs, state)
        # The shortcut lets a reflex reach the waypoint without passing the recurrent state.
        out = self.out(self.head(torch.cat([hidden, inputs], dim=-1)))  # (B, T, 4)
        return Generated(out[..., :2], out[..., 2], out[..., 3], state)

    def remember(self, start_relation: Tensor, embedding_goal: Tensor) -> Remembered:
        """What of `forward`'s arguments stays the same from tick to tick."""
        first = self.behavior.get_parameter("0.weight")[:, signature.EMBEDDING_SIZE :]
        behavior = F.linear(embedding_goal, first, self.behavior.get_parameter("0.bias"))
        columns, stride = self.guide.remember(start_relation, embedding_goal)
        return Remembered(start_relation, columns, stride, behavior)

    def gather(
        self, goal_relation: Tensor, embedding_now: Tensor, remembered: Remembered
    ) -> Tensor:
        """What the LSTM sees of `forward`'s arguments."""
        start_relation, columns, stride, behavior = remembered
        first = self.behavior.get_parameter("0.weight")[:, : signature.EMBEDDING_SIZE]
        behavior = self.behavior[1:](F.linear(embedding_now, first) + behavior)
        guide = self.guide(goal_relation, embedding_now, columns, stride)
        start_relation = start_relation.expand_as(goal_relation)
        return torch.cat([goal_relation, start_relation, behavior, guide], dim=-1)


class BehaviorNetworks(nn.Module):
    """Everything that is trained and exported."""

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
