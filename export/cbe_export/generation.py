"""The waypoint generator as two graphs: `recall`, once a behavior, and `generator`, each tick.

What `cbe_training.networks.Generator` works out is split and put together anew so that a tick has
few nodes; the parity gate holds one against the other.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cbe import signature
from cbe_export.folded import conv, gates, linear, lstm_step
from cbe_training import layout
from cbe_training.layout import PATH_POINTS
from cbe_training.networks import BehaviorNetworks
from cbe_training.path import PLACE
from cbe_training.vision import Relation

CHANNELS, ROWS, COLUMNS = signature.ATTRACTOR_SHAPE
WHOLE = torch.arange(1.0, PATH_POINTS + 1.0)
"""The path's points counted: PATH_POINTS times their share of it."""


class Recalled(NamedTuple):
    """What stays the same while a behavior lasts; laid end to end it is `recalled`."""

    view: Tensor  # (first * 10, 40) from a column of an attractor to a row of `Relation.table`
    view_bias: Tensor  # (first * 10, 1)
    start: Tensor  # (1, 4 * S + head) what the start's relation adds, see `_inner`
    columns: Tensor  # (2, 3, 18) as `Remembered.columns`
    lookahead: Tensor  # (1, 16) see `GeneratorTick._ahead`
    behavior: Tensor  # (1, 192) as `Remembered.behavior`


class RecallTick(nn.Module):
    """Graph `recall`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        self.generator = networks.generator
        self.inner, _ = _inner(networks)
        # Views whose columns are, in turn, each unit vector (40,) and then zero.
        units = torch.cat([torch.eye(CHANNELS * ROWS), torch.zeros(COLUMNS, CHANNELS * ROWS)])
        self.probes = units.unflatten(0, (-1, COLUMNS)).transpose(1, 2).flatten(1)  # (5, 400)

    def forward(
        self,
        attractor_first: Tensor,
        attractor_start: Tensor,
        attractor_goal: Tensor,
        embedding_goal: Tensor,
    ) -> Tensor:
        """See `cbe.signature.recall`."""
        recalled = self.recall(attractor_first, attractor_start, attractor_goal, embedding_goal)
        return torch.cat([part.reshape(1, -1) for part in recalled], dim=1)

    def recall(
        self, first: Tensor, start: Tensor, goal: Tensor, embedding_goal: Tensor
    ) -> Recalled:
        """The same in parts."""
        generator = self.generator
        relation: Relation = generator.relation
        # A row of the table is affine in a column of the view from here: unit vectors tell all.
        table = relation.table(self.probes, goal).transpose(1, 2).flatten(2)  # (5, 10, first * 10)
        rows = table.flatten(0, 1)
        bias = rows[CHANNELS * ROWS]
        parts = generator.remember(relation(first, start), embedding_goal)
        return Recalled(
            (rows[: CHANNELS * ROWS] - bias).T,
            bias[:, None],
            self.inner(parts.start_relation),
            parts.columns[0],
            parts.stride * (2.0 * PATH_POINTS * WHOLE) - WHOLE**2,
            parts.behavior,
        )


def recalled_shapes(networks: BehaviorNetworks) -> list[torch.Size]:
    """Of the parts of what one behavior has `Recalled`."""
    attractor = torch.zeros(1, signature.ATTRACTOR_SIZE)
    embedding = torch.zeros(1, signature.EMBEDDING_SIZE)
    with torch.no_grad():
        parts = RecallTick(networks).recall(attractor, attractor, attractor, embedding)
    return [part.shape for part in parts]


def recalled_size(networks: BehaviorNetworks) -> int:
    """Numbers in `recalled`."""
    return sum(shape.numel() for shape in recalled_shapes(networks))


class GeneratorTick(nn.Module):
    """Graph `generator`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        generator = networks.generator
        self.shapes = recalled_shapes(networks)
        self.relation = _relation(generator.relation)
        self.locate = generator.guide.locate
        self.turn_back = linear(*(part[:6] for part in layout.TURN_BACK))
        self.move_back = linear(*layout.MOVE_BACK)
        self.frame = linear(*(part[:6] for part in layout.FRAME))
        nearness = generator.guide.nearness_m.detach()
        self.near = (-(nearness**-2)).expand(1, 2).clone()
        self.guide = _guide(generator.guide.layers)
        weight = generator.behavior.get_parameter("0.weight").detach()
        self.behavior_now = weight[:, : signature.EMBEDDING_SIZE].T
        self.behavior = generator.behavior[1:]
        _, self.inner = _inner(networks)
        weight = generator.head.get_parameter("0.weight").detach()
        self.head = weight[:, : generator.lstm.hidden_size].T
        self.out = generator.out
        self.inner_sizes = [4 * generator.lstm.hidden_size, len(weight)]

    def forward(
        self, recalled: Tensor, attractor_now: Tensor, embedding_now: Tensor, state: Tensor
    ) -> tuple[Tensor, ...]:
        """See `cbe.signature.generator`."""
        parts = recalled.split([shape.numel() for shape in self.shapes], dim=1)
        recall = Recalled(*map(Tensor.view, parts, self.shapes))
        now = attractor_now.view(CHANNELS * ROWS, COLUMNS)
        table = F.relu(torch.addmm(recall.view_bias, recall.view, now))  # (first * 10, 10 of now)
        to_goal = self.relation(table.view(1, -1, COLUMNS, COLUMNS))
        end = self._seen(to_goal)
        laid = self._lay(end, embedding_now, recall.columns)
        ahead, share = self._ahead(laid, recall.lookahead)
        guide = self.guide(torch.cat([laid.view(1, -1), ahead, share, end], dim=1))
        behavior = self.behavior(torch.addmm(recall.behavior, embedding_now, self.behavior_now))
        h, c = state.chunk(2, dim=1)
        inputs = torch.cat([to_goal, behavior, guide, ahead, share, h], dim=1)
        inner = torch.addmm(recall.start, inputs, self.inner)
        of_lstm, of_head = inner.split(self.inner_sizes, dim=1)
        h, c = lstm_step(of_lstm, c)
        out = self.out(F.relu(torch.addmm(of_head, h, self.head)))  # (1, 4)
        waypoint_m, progress, on_route = out.split([2, 1, 1], dim=1)
        return waypoint_m, progress, torch.sigmoid(on_route), end, torch.cat([h, c], dim=1)

    def _seen(self, relation: Tensor) -> Tensor:
        """As `Guide.seen`: x and y as they are, cosine and sine over their norm and a bit."""
        pose = self.locate(relation)
        turn = torch.tensor([[0.0, 0.0, 1.0, 1.0]])
        norm = ((pose * pose) @ (turn.T * turn)).sqrt()  # (1, 4), 0 of x and y
        return pose / (norm + torch.tensor([[1.0, 1.0, 0.01, 0.01]]))

    def _lay(self, end: Tensor, embedding_now: Tensor, columns: Tensor) -> Tensor:
        """The remembered path (2, 2, 18) from here: by dead reckoning and by the end's view."""
        turn_back = self.turn_back(embedding_now).view(1, 2, 3)
        move_back = self.move_back(embedding_now).view(1, 3, 3)
        frames = torch.cat([turn_back @ move_back, self.frame(end).view(1, 2, 3)])
        return frames @ columns

    def _ahead(self, laid: Tensor, lookahead: Tensor) -> tuple[Tensor, Tensor]:
        """As `Guide._ahead`, of both: points (1, 4) a lookahead on, shares (1, 2) of the nearest.

        Of -(whole - there)**2 a softmax only sees what differs from point to point: a multiple of
        `share`, and `Recalled.lookahead`.
        """
        points, _ = laid.split([PATH_POINTS, 2], dim=2)
        near = (self.near @ (points * points)).softmax(dim=2)
        share = near @ (WHOLE[:, None] / PATH_POINTS)  # (2, 1, 1)
        weights = (share * (2.0 * PATH_POINTS * WHOLE) + lookahead).softmax(dim=2)
        return (points @ weights.view(2, -1, 1)).view(1, 4), share.view(1, 2)


def _relation(relation: Relation) -> nn.Sequential:
    """`Relation.layers` after its first ReLU, of a table with rows and columns exchanged."""
    stored = relation.layers.state_dict()
    weight, read = stored["1.weight"], stored["4.weight"]
    channels, half = len(weight), COLUMNS // 2
    read = read.unflatten(1, (channels, half, half)).transpose(2, 3).flatten(1)
    return nn.Sequential(
        conv(weight.transpose(2, 3), stored["1.bias"], stride=2, padding=1),
        nn.ReLU(),
        nn.Flatten(),
        linear(read, stored["4.bias"]),
        nn.ReLU(),
    )


def _guide(layers: nn.Sequential) -> nn.Sequential:
    """`Guide.layers` of both paths as they are laid, unscaled, then all else of both."""
    stored = layers.state_dict()
    weight = stored["0.weight"]
    sizes = [2 * len(layout.SCALE), 2, 1]  # of one path: as it is laid, ahead on it, its share
    both, pose = weight.split([2 * sum(sizes), PLACE], dim=1)
    laid, ahead, share = both.unflatten(1, (2, sum(sizes))).split(sizes, dim=2)
    laid = laid * layout.SCALE.repeat(2)
    parts = [laid.flatten(1), ahead.flatten(1), share.flatten(1), pose]
    return nn.Sequential(
        linear(torch.cat(parts, dim=1), stored["0.bias"]),
        nn.ReLU(),
        linear(stored["2.weight"], stored["2.bias"]),
        nn.ReLU(),
    )


def _inner(networks: BehaviorNetworks) -> tuple[nn.Linear, Tensor]:
    """The LSTM's gates and, below them, the inputs' share of the head's first layer.

    As a layer of the start's relation, which brings the biases, and the weights
    (I - relation + S, 4 * S + head) of all other inputs and h.
    """
    generator, size = networks.generator, networks.config.relation
    state = generator.lstm.hidden_size
    lstm, head = gates(generator.lstm), generator.head.state_dict()
    of_h, of_inputs = head["0.weight"].split([state, lstm.in_features - state], dim=1)
    none = torch.zeros_like(of_h)
    weight = torch.cat([lstm.weight.detach(), torch.cat([of_inputs, none], dim=1)])
    bias = torch.cat([lstm.bias.detach(), head["0.bias"]])
    goal, start, rest = weight.split([size, size, weight.shape[1] - 2 * size], dim=1)
    return linear(start, bias), torch.cat([goal, rest], dim=1).T
