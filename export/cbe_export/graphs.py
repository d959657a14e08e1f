"""One tick of the trained networks as modules with the tensors of `cbe.signature`."""

import torch
from torch import Tensor, nn

from cbe import signature
from cbe_training.losses import AuxiliaryHeads
from cbe_training.networks import STEP_SCALE, BehaviorNetworks, add_up, place

POSE = 3


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
    """Graph `encoder`; the dead-reckoned pose travels as the last three numbers of `h`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        self.trunk = networks.trunk
        self.pair = networks.encoder.pair
        self.lstm = LstmCell(networks.encoder.lstm)
        self.odometry = networks.encoder.odometry
        self.to_embedding = networks.encoder.to_embedding

    def forward(
        self, image: Tensor, previous_features: Tensor, is_first: Tensor, h: Tensor, c: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See `cbe.signature.encoder`."""
        features = self.trunk(image)
        first = is_first.view(1, 1, 1, 1)
        previous = first * features + (1.0 - first) * previous_features
        # A new behavior starts from nothing, whatever state was passed in.
        h, c = (1.0 - is_first) * h, (1.0 - is_first) * c
        h, pose = h.split([h.shape[1] - POSE, POSE], dim=1)
        c, spare = c.split([c.shape[1] - POSE, POSE], dim=1)
        motion = self.pair(features, previous)
        step = (1.0 - is_first) * self.odometry(motion) / STEP_SCALE
        pose = add_up(step[:, None], pose)[:, 0]
        h, c = self.lstm(torch.cat([motion, place(pose)], dim=1), h, c)
        embedding = self.to_embedding(torch.cat([h, place(pose)], dim=1))
        return features, embedding, torch.cat([h, pose], dim=1), torch.cat([c, spare], dim=1)


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
        generator = networks.generator
        self.relation = generator.relation
        self.behavior = generator.behavior
        self.lstm = LstmCell(generator.lstm)
        self.head = generator.head
        self.out = generator.out

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
        relations = self.relation(now, target).reshape(1, -1)  # (1, 2 * relation), goal first
        behavior = self.behavior(torch.cat([embedding_now, embedding_goal], dim=1))
        inputs = torch.cat([relations, behavior], dim=1)
        h, c = self.lstm(inputs, h, c)
        out = self.out(self.head(torch.cat([h, inputs], dim=1)))  # (1, 4)
        return out[:, :2], out[:, 2], torch.sigmoid(out[:, 3]), h, c


class ShapeTick(nn.Module):
    """Graph `shape`."""

    def __init__(self, heads: AuxiliaryHeads) -> None:
        super().__init__()
        self.shape = heads.shape

    def forward(self, embedding: Tensor) -> Tensor:
        """See `cbe.signature.shape`."""
        return self.shape(embedding).view(1, signature.SHAPE_POINTS, 2)


def encoder_signature(networks: BehaviorNetworks) -> signature.Graph:
    """Tensors of the encoder: its state is the LSTM's and the pose."""
    return signature.encoder(networks.config.encoder_state + POSE)


def ticks(
    networks: BehaviorNetworks, heads: AuxiliaryHeads
) -> list[tuple[signature.Graph, nn.Module]]:
    """All graphs with the modules that compute them."""
    config = networks.config
    return [
        (encoder_signature(networks), EncoderTick(networks)),
        (signature.attractor(), AttractorTick(networks)),
        (signature.generator(config.generator_state), GeneratorTick(networks)),
        (signature.shape(), ShapeTick(heads)),
    ]
