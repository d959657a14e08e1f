"""The behavior networks: encoder, attractor and waypoint generator on one trunk.

Paper, Sec. III-B and III-C, at a twentieth of the authors' parameters.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from cbe import signature
from cbe_training import layout, path
from cbe_training.config import NetworkConfig
from cbe_training.layout import PATH_POINTS, TRACED
from cbe_training.path import PLACE, PLACE_M, Path, place
from cbe_training.vision import Attractor, Pair, Relation, Trunk

STEP_SCALE = 5.0
LOOKAHEAD_M = 0.6
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
        self.odometry = nn.Linear(config.motion, 3)
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

    def forward(
        self,
        goal_relation: Tensor,
        start_relation: Tensor,
        embedding_now: Tensor,
        embedding_goal: Tensor,
    ) -> Tensor:
        """As `Generator.forward`, to (B, T, size)."""
        # (B, T, 2, 4) poses of the goal, seen from here, and the start, from the first frame.
        seen = self.locate(torch.stack([goal_relation, start_relation], dim=-2))
        turn = seen[..., 2:]
        norm = torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
        seen = torch.cat([seen[..., :2], turn / (norm + 0.01)], dim=-1)
        goal, start = layout.frame(seen).unbind(-3)
        reckoned = layout.into(embedding_now) @ (start @ layout.from_start(embedding_goal))
        sighted = goal @ layout.from_end(embedding_goal)
        laid = torch.stack([reckoned, sighted], dim=-3)[..., :2, :]  # (B, T, 2, 2, 18)
        ahead, share = self._ahead(laid[..., :PATH_POINTS], layout.length_m(embedding_goal))
        scaled = (laid * layout.SCALE.to(laid)).flatten(-2)
        reasons = torch.cat([scaled, ahead, share], dim=-1).flatten(-2)
        read = self.layers(torch.cat([reasons, seen[..., 0, :]], dim=-1))
        return torch.cat([read, ahead.flatten(-2), share.flatten(-2)], dim=-1)

    def _ahead(self, points: Tensor, length_m: Tensor) -> tuple[Tensor, Tensor]:
        """The point (..., 2) a lookahead on from the nearest of (..., 2, P), and that one's share.

        All softly, so that gradients pass.
        """
        shares = torch.arange(1, PATH_POINTS + 1).to(points) / PATH_POINTS
        near = -((points / self.nearness_m) ** 2).sum(dim=-2)
        share = (near.softmax(dim=-1) * shares).sum(dim=-1, keepdim=True)
        there = share + (LOOKAHEAD_M / (length_m + LOOKAHEAD_M))[..., None]
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
        """Relations (B, T, relation), embeddings (B, T, 32); the goal's may be broadcast over T."""
        inputs = self.gather(goal_relation, start_relation, embedding_now, embedding_goal)
        hidden, state = self.lstm(inputs, state)
        # The shortcut lets a reflex reach the waypoint without passing the recurrent state.
        out = self.out(self.head(torch.cat([hidden, inputs], dim=-1)))  # (B, T, 4)
        return Generated(out[..., :2], out[..., 2], out[..., 3], state)

    def gather(
        self,
        goal_relation: Tensor,
        start_relation: Tensor,
        embedding_now: Tensor,
        embedding_goal: Tensor,
    ) -> Tensor:
        """What the LSTM sees of `forward`'s arguments."""
        behavior = self.behavior(torch.cat([embedding_now, embedding_goal], dim=-1))
        guide = self.guide(goal_relation, start_relation, embedding_now, embedding_goal)
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
