"""One tick of the trained networks as modules with the tensors of `cbe.signature`."""

import torch
from torch import Tensor, nn

from cbe import signature
from cbe_training import path
from cbe_training.layout import path_of
from cbe_training.networks import BehaviorNetworks

PATH = 3 + 2 * path.DEGREES + 1  # numbers of a `path.Path`


class LstmCell(nn.Module):
    """One step of an LSTM as a single matrix product, which onnxruntime can also quantise."""

    def __init__(self, lstm: nn.LSTM) -> None:
        super().__init__()
        stored = lstm.state_dict()
        weights = torch.cat([stored["weight_ih_l0"], stored["weight_hh_l0"]], dim=1)
        self.gates = nn.Linear(weights.shape[1], weights.shape[0])
        self.gates.weight = nn.Parameter(weights)
        self.gates.bias = nn.Parameter(stored["bias_ih_l0"] + stored["bias_hh_l0"])

    def forward(self, x: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """Input (1, I) and state (1, S) twice, to the next state."""
        keep_in, forget, new, out = self.gates(torch.cat([x, h], dim=1)).chunk(4, dim=1)
        c = torch.sigmoid(forget) * c + torch.sigmoid(keep_in) * torch.tanh(new)
        return torch.sigmoid(out) * torch.tanh(c), c


class EncoderTick(nn.Module):
    """Graph `encoder`; the path travels as the last numbers of `h`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        self.trunk = networks.trunk
        self.encoder = networks.encoder
        self.lstm = LstmCell(networks.encoder.lstm)

    def forward(
        self, image: Tensor, previous_features: Tensor, is_first: Tensor, h: Tensor, c: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See `cbe.signature.encoder`."""
        features = self.trunk(image)
        first = is_first.view(1, 1, 1, 1)
        previous = first * features + (1.0 - first) * previous_features
        # A new behavior starts from nothing, whatever state was passed in.
        h, c = (1.0 - is_first) * h, (1.0 - is_first) * c
        h, packed = h.split([h.shape[1] - PATH, PATH], dim=1)
        c, spare = c.split([c.shape[1] - PATH, PATH], dim=1)
        motion = self.encoder.pair(features, previous)
        step = (1.0 - is_first) * self.encoder.step(motion)
        after = path.advance(_unpack(packed), step)
        h, c = self.lstm(torch.cat([motion, path.place(after.pose)], dim=1), h, c)
        embedding = self.encoder.embed(h, after.pose, after.series)
        packed = torch.cat([after.pose, after.series.flatten(1), after.frames], dim=1)
        return features, embedding, torch.cat([h, packed], dim=1), torch.cat([c, spare], dim=1)


def _unpack(packed: Tensor) -> path.Path:
    pose, series, frames = packed.split([3, 2 * path.DEGREES, 1], dim=1)
    return path.Path(pose, series.view(1, 2, path.DEGREES), frames)


class AttractorTick(nn.Module):
    """Graph `attractor`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        self.attractor = networks.attractor

    def forward(self, features: Tensor) -> Tensor:
        """See `cbe.signature.attractor`."""
        return self.attractor(features)


class GeneratorTick(nn.Module):
    """Graph `generator`; both relations pass through the convolutions as one batch of two."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        self.generator = networks.generator
        self.lstm = LstmCell(networks.generator.lstm)

    def forward(
        self,
        attractor_now: Tensor,
        attractor_first: Tensor,
        attractor_start: Tensor,
        attractor_goal: Tensor,
        embedding_now: Tensor,
        embedding_goal: Tensor,
        h: Tensor,
        c: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """See `cbe.signature.generator`."""
        now = torch.cat([attractor_now, attractor_first])
        target = torch.cat([attractor_goal, attractor_start])
        to_goal, to_start = self.generator.relation(now, target).split(1)
        inputs = self.generator.gather(to_goal, to_start, embedding_now, embedding_goal)
        h, c = self.lstm(inputs, h, c)
        out = self.generator.out(self.generator.head(torch.cat([h, inputs], dim=1)))  # (1, 4)
        return out[:, :2], out[:, 2], torch.sigmoid(out[:, 3]), h, c


class ShapeTick(nn.Module):
    """Graph `shape`."""

    def forward(self, embedding: Tensor) -> Tensor:
        """See `cbe.signature.shape`."""
        return path_of(embedding, signature.SHAPE_POINTS)


def encoder_signature(networks: BehaviorNetworks) -> signature.Graph:
    """Tensors of the encoder: its state is the LSTM's and the path."""
    return signature.encoder(networks.config.encoder_state + PATH)


def ticks(networks: BehaviorNetworks) -> list[tuple[signature.Graph, nn.Module]]:
    """All graphs with the modules that compute them."""
    return [
        (encoder_signature(networks), EncoderTick(networks)),
        (signature.attractor(), AttractorTick(networks)),
        (signature.generator(networks.config.generator_state), GeneratorTick(networks)),
        (signature.shape(), ShapeTick()),
    ]
