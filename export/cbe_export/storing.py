"""How graphs are stored: large weights in half precision, nothing of the code they came from."""

from pathlib import Path

import numpy as np
import onnx
import onnx.numpy_helper

LARGE = 1024  # numbers: smaller tensors are not worth a node


def save(model: onnx.ModelProto, path: Path, metadata: dict[str, str]) -> None:
    """Check a graph and write it, small and with the metadata that the runtime reads."""
    store_in_half(model)
    strip(model.graph)
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def strip(graph: onnx.GraphProto) -> None:
    """Leave out what the exporter notes of the code it came from, half as large as the weights."""
    del graph.metadata_props[:]
    del graph.value_info[:]
    graph.doc_string = ""
    for node in graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*graph.input, *graph.output, *graph.initializer):
        del value.metadata_props[:]
        value.doc_string = ""


def store_in_half(model: onnx.ModelProto) -> None:
    """Store large weights as float16 where nothing is lost, cast back as the session is made."""
    graph = model.graph
    casts = []
    for tensor in graph.initializer:
        value = onnx.numpy_helper.to_array(tensor)
        if value.dtype != np.float32 or value.size < LARGE:
            continue
        half = value.astype(np.float16)
        if not np.array_equal(half, value):
            continue
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(half, f"{name}.half"))
        casts.append(
            onnx.helper.make_node("Cast", [tensor.name], [name], to=onnx.TensorProto.FLOAT)
        )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def restore_from_half(model: onnx.ModelProto) -> None:
    """Undo `store_in_half`: the weights are initialisers in single precision again."""
    graph = model.graph
    stored = {tensor.name: tensor for tensor in graph.initializer}
    nodes = []
    for node in graph.node:
        half = stored.get(node.input[0]) if node.op_type == "Cast" else None
        if half is None:
            nodes.append(node)
            continue
        value = onnx.numpy_helper.to_array(half).astype(np.float32)
        half.CopyFrom(onnx.numpy_helper.from_array(value, node.output[0]))
    del graph.node[:]
    graph.node.extend(nodes)
