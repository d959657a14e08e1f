"""Layers of trained weights, put together so that a graph needs few nodes.

Where caches are cold, as on a robot at 10 Hz, a tick pays for each node far more than for its sums.
"""

import torch
from torch import Tensor, nn


def linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    """A layer (O, I) of these weights."""
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.weight, layer.bias = nn.Parameter(weight), nn.Parameter(bias)
    return layer


def conv(weight: Tensor, bias: Tensor | None, *, stride: int = 1, padding: int = 0) -> nn.Conv2d:
    """A convolution (O, I, rows, columns) of these weights."""
    outputs, inputs, rows, columns = weight.shape
    layer = nn.Conv2d(
        inputs, outputs, (rows, columns), stride=stride, padding=padding, bias=bias is not None
    )
    layer.weight = nn.Parameter(weight)
    if bias is not None:
        layer.bias = nn.Parameter(bias)
    return layer


def gates(lstm: nn.LSTM) -> nn.Linear:
    """All gates (4 * S) of an LSTM in one product of its input and h side by side (I + S)."""
    stored = lstm.state_dict()
    return linear(
        torch.cat([stored["weight_ih_l0"], stored["weight_hh_l0"]], dim=1),
        stored["bias_ih_l0"] + stored["bias_hh_l0"],
    )


def lstm_step(of_gates: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """What `gates` gives (1, 4 * S) and c (1, S) to the next h and c, so that it quantises."""
    keep_in, forget, new, out = of_gates.chunk(4, dim=1)
    c = torch.sigmoid(forget) * c + torch.sigmoid(keep_in) * torch.tanh(new)
    return torch.sigmoid(out) * torch.tanh(c), c


def normalised(image: Tensor) -> Tensor:
    """As `Trunk.forward` has it, x / 64 - 2, in one node."""
    batch, height, width, colours = image.shape
    return torch.onnx.ops.symbolic(
        "DequantizeLinear",
        (image.permute(0, 3, 1, 2), torch.tensor(1.0 / 64.0), torch.tensor(128, dtype=torch.uint8)),
        dtype=torch.float32,
        shape=(batch, colours, height, width),
    )
