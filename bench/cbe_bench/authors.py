"""The authors' architecture with random weights, to time ours against.

Layer for layer as in their public implementation: motion encoder, attractor, the relation to the
goal and the generator of one tick, as one graph. The relation to the start is computed once a
behavior there and comes in as an input; so do the images, already float and stacked. Whatever a
robot would have to add to that is left out in their favour.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

ENCODER_STATE, GENERATOR_STATE = 512, 1024
EMBEDDING, ATTRACTOR_CHANNELS, RELATION = 32, 32, 512

Arrays = dict[str, NDArray[np.float32]]

INPUTS: dict[str, tuple[int, ...]] = {
    "pair": (1, 9, 64, 64),  # o_t, o_{t-1} and their difference
    "image": (1, 3, 64, 64),
    "goal": (1, ATTRACTOR_CHANNELS, 5, 5),
    "start_relation": (1, RELATION),
    "goal_embedding": (1, EMBEDDING),
    "encoder_h": (1, 1, ENCODER_STATE),
    "encoder_c": (1, 1, ENCODER_STATE),
    "generator_h": (1, 1, GENERATOR_STATE),
    "generator_c": (1, 1, GENERATOR_STATE),
}
RECURRENT = ("encoder_h", "encoder_c", "generator_h", "generator_c")


@dataclass
class _Graph:
    """Nodes and random weights as they are added."""

    rng: np.random.Generator
    nodes: list[onnx.NodeProto] = field(default_factory=list)
    weights: list[onnx.TensorProto] = field(default_factory=list)

    def weight(self, name: str, *shape: int) -> str:
        fan_in = int(np.prod(shape[1:])) or 1
        value = self.rng.normal(0.0, fan_in**-0.5, shape).astype(np.float32)
        self.weights.append(numpy_helper.from_array(value, name))
        return name

    def add(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(kind, inputs, [output], None, None, None, **attributes))
        return output

    def conv(self, x: str, name: str, channels: int, filters: int, kernel: int, stride: int) -> str:
        inputs = [
            x,
            self.weight(f"{name}_w", filters, channels, kernel, kernel),
            self.weight(f"{name}_b", filters),
        ]
        y = self.add("Conv", inputs, f"{name}_y", strides=[stride, stride])
        return self.add("Relu", [y], f"{name}_out")

    def linear(self, x: str, name: str, inputs: int, outputs: int) -> str:
        parts = [x, self.weight(f"{name}_w", outputs, inputs), self.weight(f"{name}_b", outputs)]
        return self.add("Gemm", parts, f"{name}_out", transB=1)

    def lstm(self, x: str, name: str, inputs: int, size: int) -> str:
        """One step; (1, size), with the next state in `<name>_h_next` and `<name>_c_next`."""
        first = self.weight(f"{name}_w", 1, 4 * size, inputs)
        again = self.weight(f"{name}_r", 1, 4 * size, size)
        bias = self.weight(f"{name}_b", 1, 8 * size)
        sequence = self.add("Unsqueeze", [x, "front"], f"{name}_x")
        outputs = ["", f"{name}_h_next", f"{name}_c_next"]
        state = [f"{name}_h", f"{name}_c"]
        self.nodes.append(
            helper.make_node(
                "LSTM", [sequence, first, again, bias, "", *state], outputs, hidden_size=size
            )
        )
        return self.add("Squeeze", [f"{name}_h_next", "front"], f"{name}_hidden")


def write(path: Path) -> Path:
    """Write the graph, some 71 MB, to `path`."""
    graph = _Graph(np.random.default_rng(0))
    graph.weights.append(numpy_helper.from_array(np.array([0], np.int64), "front"))
    x = "pair"
    for index, (channels, filters, stride) in enumerate(
        ((9, 64, 2), (64, 128, 2), (128, 256, 2), (256, 512, 1))
    ):
        x = graph.conv(x, f"motion{index}", channels, filters, 5, stride)
    x = graph.add("Flatten", [x], "motion")  # (1, 512)
    hidden = graph.lstm(x, "encoder", 512, ENCODER_STATE)
    embedding = graph.linear(hidden, "embedding", ENCODER_STATE, EMBEDDING)

    x = "image"
    for index, channels in enumerate((3, ATTRACTOR_CHANNELS, ATTRACTOR_CHANNELS)):
        x = graph.conv(x, f"attractor{index}", channels, ATTRACTOR_CHANNELS, 5, 2)
    difference = graph.add("Sub", [x, "goal"], "difference")
    x = graph.add("Concat", [x, "goal", difference], "attractors", axis=1)  # (1, 96, 5, 5)
    x = graph.conv(x, "relation0", 3 * ATTRACTOR_CHANNELS, 256, 3, 1)
    x = graph.conv(x, "relation1", 256, 512, 3, 1)
    x = graph.conv(x, "relation2", 512, RELATION, 1, 1)
    relation = graph.add("Flatten", [x], "goal_relation")

    parts = [relation, "start_relation", embedding, "goal_embedding"]
    x = graph.add("Concat", parts, "state", axis=1)  # (1, 1088)
    hidden = graph.lstm(x, "generator", 2 * RELATION + 2 * EMBEDDING, GENERATOR_STATE)
    for name, outputs in (("progress", 1), ("waypoint", 2)):
        x = graph.linear(hidden, f"{name}0", GENERATOR_STATE, 512)
        x = graph.add("Relu", [x], f"{name}0_relu")
        graph.linear(x, name, 512, outputs)

    results: dict[str, tuple[int, ...]] = {
        "progress_out": (1, 1),
        "waypoint_out": (1, 2),
        "embedding_out": (1, EMBEDDING),
    } | {f"{name}_next": INPUTS[name] for name in RECURRENT}
    body = helper.make_graph(
        graph.nodes, "authors", _infos(INPUTS), _infos(results), initializer=graph.weights
    )
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path)
    return path


def _infos(shapes: dict[str, tuple[int, ...]]) -> list[onnx.ValueInfoProto]:
    return [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()]
