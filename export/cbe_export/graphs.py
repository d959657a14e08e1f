"""One tick of the trained networks as modules with the tensors of `cbe.signature`."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cbe import signature
from cbe_training import path
from cbe_training.layout import path_of
from cbe_training.networks import BehaviorNetworks, Remembered
from cbe_training.vision import Pair

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


class PairTick(nn.Module):
    """Motion features of one pair of frames, both through one convolution side by side."""

    def __init__(self, pair: Pair) -> None:
        super().__init__()
        stored = pair.first.state_dict()
        weights = torch.cat(stored["weight"].chunk(2), dim=1)  # of now, then of the frame before
        self.first = nn.Conv2d(weights.shape[1], weights.shape[0], 3, stride=2, padding=1)
        self.first.weight = nn.Parameter(weights)
        self.first.bias = nn.Parameter(sum(stored["bias"].chunk(2)))
        self.rest = pair.rest

    def forward(self, features: Tensor, previous: Tensor) -> Tensor:
        """Features (1, 32, 16, 16) of a frame and of the one before, to (1, motion)."""
        return self.rest(self.first(torch.cat([features, previous], dim=1)))


class EncoderTick(nn.Module):
    """Graph `encoder`; the path travels as the last numbers of `h`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        self.trunk = networks.trunk
        self.encoder = networks.encoder
        self.pair = PairTick(networks.encoder.pair)
        self.lstm = LstmCell(networks.encoder.lstm)

    def forward(
        self, image: Tensor, previous_features: Tensor, is_first: Tensor, h: Tensor, c: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See `cbe.signature.encoder`."""
        features = F.relu(self.trunk.stem(_normalised(image)))
        previous = torch.where(is_first.view(1, 1, 1, 1) > 0.0, features, previous_features)
        # A new behavior starts from nothing, whatever state was passed in.
        again = 1.0 - is_first
        h, c = again * h, again * c
        size = h.shape[1] - PATH
        h, pose, series, frames = h.split([size, 3, 2 * path.DEGREES, 1], dim=1)
        c, spare = c.split([size, PATH], dim=1)
        motion = self.pair(features, previous)
        before = path.Path(pose, series.view(1, 2, path.DEGREES), frames)
        after = path.advance(before, again * self.encoder.step(motion))
        h, c = self.lstm(torch.cat([motion, path.place(after.pose)], dim=1), h, c)
        embedding = self.encoder.embed(h, after.pose, after.series)
        h = torch.cat([h, after.pose, after.series.flatten(1), after.frames], dim=1)
        return features, embedding, h, torch.cat([c, spare], dim=1)


def _normalised(image: Tensor) -> Tensor:
    """As `Trunk.forward` has it, x / 64 - 2, in one node."""
    batch, height, width, colours = image.shape
    return torch.onnx.ops.symbolic(
        "DequantizeLinear",
        (image.permute(0, 3, 1, 2), torch.tensor(1.0 / 64.0), torch.tensor(128, dtype=torch.uint8)),
        dtype=torch.float32,
        shape=(batch, colours, height, width),
    )


class AttractorTick(nn.Module):
    """Graph `attractor`."""

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        first, _, second = networks.attractor.layers.children()
        weight = second.get_parameter("weight")  # (8, width, 4, 7)
        outputs, width, rows, columns = weight.shape
        # Few outputs leave a convolution idle, so each row of the kernel gets its own, and a
        # second one adds them up.
        each = nn.Conv2d(width, rows * outputs, (1, columns), bias=False)
        each.weight = nn.Parameter(weight.permute(2, 0, 1, 3).flatten(0, 1)[:, :, None])
        together = nn.Conv2d(rows * outputs, outputs, (rows, 1))
        adding = torch.einsum("op,kl->okpl", torch.eye(outputs), torch.eye(rows))
        together.weight = nn.Parameter(adding.flatten(1, 2)[..., None])
        together.bias = nn.Parameter(second.get_parameter("bias"))
        self.layers = nn.Sequential(first, nn.ReLU(), each, together, nn.Sigmoid(), nn.Flatten())

    def forward(self, features: Tensor) -> Tensor:
        """See `cbe.signature.attractor`."""
        return self.layers(features)


class GeneratorTick(nn.Module):
    """Graph `generator`; what stays the same while a behavior lasts travels in `h`.

    It is worked out on the behavior's first tick, whose state is all zeros, and only then.
    """

    def __init__(self, networks: BehaviorNetworks) -> None:
        super().__init__()
        self.generator = networks.generator
        self.lstm = LstmCell(networks.generator.lstm)
        self.shapes = remembered_shapes(networks)

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
    ) -> tuple[Tensor, ...]:
        """See `cbe.signature.generator`."""
        sizes = [1, *(math.prod(shape) for shape in self.shapes)]
        kept_size = sum(sizes)
        h, kept = h.split([h.shape[1] - kept_size, kept_size], dim=1)
        c, spare = c.split([c.shape[1] - kept_size, kept_size], dim=1)
        kept = torch.cond(
            kept[0, 0] > 0.0,
            lambda kept, *_: kept.clone(memory_format=torch.contiguous_format),
            lambda _, *arguments: self._remember(*arguments),
            (kept, attractor_first, attractor_start, embedding_goal),
        )
        parts = kept.split(sizes, dim=1)[1:]
        remembered = Remembered(*map(Tensor.view, parts, self.shapes))
        to_goal = self.generator.relation(attractor_now, attractor_goal)
        inputs = self.generator.gather(to_goal, embedding_now, remembered)
        h, c = self.lstm(inputs, h, c)
        out = self.generator.out(self.generator.head(torch.cat([h, inputs], dim=1)))  # (1, 4)
        h, c = torch.cat([h, kept], dim=1), torch.cat([c, spare], dim=1)
        end = self.generator.guide.seen(to_goal)
        return out[:, :2], out[:, 2], torch.sigmoid(out[:, 3]), end, h, c

    def _remember(self, first: Tensor, start: Tensor, embedding_goal: Tensor) -> Tensor:
        """One, for known, and then all that is `Remembered`."""
        relation = self.generator.relation(first, start)
        parts = self.generator.remember(relation, embedding_goal)
        return torch.cat([torch.ones_like(parts.stride), *(p.flatten(1) for p in parts)], dim=1)


def remembered_shapes(networks: BehaviorNetworks) -> list[tuple[int, ...]]:
    """Of the parts of what one behavior has `Remembered`."""
    relation = torch.zeros(1, networks.config.relation)
    with torch.no_grad():
        parts = networks.generator.remember(relation, torch.zeros(1, signature.EMBEDDING_SIZE))
    return [tuple(part.shape) for part in parts]


class ShapeTick(nn.Module):
    """Graph `shape`."""

    def forward(self, embedding: Tensor) -> Tensor:
        """See `cbe.signature.shape`."""
        return path_of(embedding, signature.SHAPE_POINTS)


def encoder_signature(networks: BehaviorNetworks) -> signature.Graph:
    """Tensors of the encoder: its state is the LSTM's and the path."""
    return signature.encoder(networks.config.encoder_state + PATH)


def generator_signature(networks: BehaviorNetworks) -> signature.Graph:
    """Tensors of the generator: its state is the LSTM's and what is remembered."""
    remembered = 1 + sum(map(math.prod, remembered_shapes(networks)))
    return signature.generator(networks.config.generator_state + remembered)


def ticks(networks: BehaviorNetworks) -> list[tuple[signature.Graph, nn.Module]]:
    """All graphs with the modules that compute them."""
    return [
        (encoder_signature(networks), EncoderTick(networks)),
        (signature.attractor(), AttractorTick(networks)),
        (generator_signature(networks), GeneratorTick(networks)),
        (signature.shape(), ShapeTick()),
    ]
