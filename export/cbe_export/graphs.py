"""One tick of the trained networks as modules with the tensors of `cbe.signature`."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cbe import signature
from cbe_export.folded import conv, gates, linear, lstm_step, normalised
from cbe_export.generation import GeneratorTick, RecallTick, recalled_size
from cbe_training import path
from cbe_training.layout import TRACED, path_of
from cbe_training.networks import STEP_SCALE, BehaviorNetworks, Encoder


class EncoderTick(nn.Module):
    """Graph `encoder`; the state is all that `cbe_training.networks.Encoder` carries, in a row.

    The path is in the units of z, and of the frame before is kept what its convolution adds.
    """

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        encoder = networks.encoder
        self.stem = networks.trunk.stem
        self.pair = encoder.pair
        self.odometry = _odometry(encoder)
        self.gates = gates(encoder.lstm)
        self.embed = _embed(encoder)
        self.sizes = state_sizes(networks)
        self.quarters = path.QUARTERS.float()
        recursion = path.RECURSION.unflatten(-1, (path.DEGREES + 1, path.DEGREES))
        halved = torch.ones(path.DEGREES + 1, 1)
        halved[-1] = 0.5  # of the two ends of a step comes the point midway
        self.recursion = halved * recursion

    def forward(self, image: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `cbe.signature.encoder`."""
        h, start, _, series, c, yaw, frames, kept = state.split(self.sizes, dim=1)
        seen = frames.clamp(max=1.0)
        features = F.relu(self.stem(normalised(image)))
        now, before = self.pair.first(features).chunk(2, dim=1)
        previous = kept.view(before.shape) + (1.0 - seen) * before  # the first is its own
        motion = self.pair.rest(now + previous)
        move, turn = (seen * self.odometry(motion)).split([2, 1], dim=1)
        x_y = start + move @ (yaw + self.quarters).cos()
        yaw = yaw + turn
        direction = (yaw + self.quarters[:1]).cos()
        frame = frames.clamp(max=path.LONGEST - 1).long().view(1)
        points = torch.cat([series.view(2, -1), (start + x_y).view(2, 1)], dim=1)
        series = (points @ self.recursion.index_select(0, frame)).view(1, -1)
        h, c = lstm_step(self.gates(torch.cat([motion, x_y, direction, h], dim=1)), c)
        h = torch.cat([h, x_y, direction, series], dim=1)
        state = torch.cat([h, c, yaw, frames + 1.0, before.flatten(1)], dim=1)
        return features, self.embed(h), state


def state_sizes(networks: BehaviorNetworks) -> list[int]:
    """Of the parts of the encoder's state."""
    size, (kept, _) = networks.config.encoder_state, networks.config.pair_channels
    return [size, 2, 2, 2 * path.DEGREES, size, 1, 1, kept * math.prod(signature.FEATURES[1:]) // 4]


def _odometry(encoder: Encoder) -> nn.Sequential:
    """`Encoder.step` with moves in the units of z."""
    stored = encoder.odometry.state_dict()
    units = STEP_SCALE * torch.tensor([path.PLACE_M, path.PLACE_M, 1.0])
    return nn.Sequential(
        linear(stored["0.weight"], stored["0.bias"]),
        nn.ReLU(),
        linear(stored["2.weight"] / units[:, None], stored["2.bias"] / units),
    )


def _embed(encoder: Encoder) -> nn.Linear:
    """`Encoder.embed` in one product: what z says of the path passes through as it is."""
    stored = encoder.to_embedding.state_dict()
    passed = torch.eye(stored["weight"].shape[1])[-TRACED:]
    return linear(
        torch.cat([passed, stored["weight"]]), torch.cat([torch.zeros(TRACED), stored["bias"]])
    )


class AttractorTick(nn.Module):
    """Graph `attractor`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        first, _, second = networks.attractor.layers.children()
        weight = second.get_parameter("weight")  # (8, width, 4, 7)
        outputs, _, rows, _ = weight.shape
        # Few outputs leave a convolution idle, so each row of the kernel gets its own, and a
        # second one adds them up.
        each = conv(weight.permute(2, 0, 1, 3).flatten(0, 1)[:, :, None], None)
        adding = torch.einsum("op,kl->okpl", torch.eye(outputs), torch.eye(rows))
        together = conv(adding.flatten(1, 2)[..., None], second.get_parameter("bias"))
        self.layers = nn.Sequential(first, nn.ReLU(), each, together, nn.Sigmoid(), nn.Flatten())

    def forward(self, features: Tensor) -> Tensor:
        """See `cbe.signature.attractor`."""
        return self.layers(features)


class ShapeTick(nn.Module):
    """Graph `shape`."""

    def forward(self, embedding: Tensor) -> Tensor:
        """See `cbe.signature.shape`."""
        return path_of(embedding, signature.SHAPE_POINTS)


def encoder_signature(networks: BehaviorNetworks) -> signature.Graph:
    """Tensors of the encoder."""
    return signature.encoder(sum(state_sizes(networks)))


def generator_signature(networks: BehaviorNetworks) -> signature.Graph:
    """Tensors of the generator."""
    return signature.generator(2 * networks.config.generator_state, recalled_size(networks))


def ticks(networks: BehaviorNetworks) -> list[tuple[signature.Graph, nn.Module]]:
    """All graphs with the modules that compute them."""
    return [
        (encoder_signature(networks), EncoderTick(networks)),
        (signature.attractor(), AttractorTick(networks)),
        (signature.recall(recalled_size(networks)), RecallTick(networks)),
        (generator_signature(networks), GeneratorTick(networks)),
        (signature.shape(), ShapeTick()),
    ]
