"""Model folders: an ONNX file for each network."""

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from cbe import signature
from cbe.camera import MODEL_CAMERA
from cbe.errors import ModelError
from cbe_runtime import modelheader
from cbe_runtime.modelfile import MAX_FILE_BYTES
from cbe_runtime.networks import GRAPHS, Networks

from .harness import SEED
from .mutate import mutants

SHIPPED = Path(modelheader.__file__).parent / "models"
METADATA = {
    "cbe.contract_version": str(signature.CONTRACT_VERSION),
    "cbe.model_id": "00112233445566aa",
    "cbe.network_period": "1",
    "cbe.camera": json.dumps(MODEL_CAMERA.to_dict()),
    "cbe.segment_steps": "40",
    "cbe.precision": "fp32",
}


def attractor(metadata, nodes=None, weights=None):
    """A tiny attractor, or one of other nodes between the same ends."""
    graph = signature.attractor()
    (source,), (target,) = graph.inputs, graph.outputs
    if nodes is None:
        weights = {"mix": np.ones((signature.FEATURES[0], signature.ATTRACTOR_SIZE), np.float32)}
        nodes = [
            helper.make_node("ReduceMean", ["features"], ["mean"], axes=[2, 3], keepdims=0),
            helper.make_node("MatMul", ["mean", "mix"], ["mixed"]),
            helper.make_node("Sigmoid", ["mixed"], ["attractor"]),
        ]
    body = helper.make_graph(
        nodes,
        graph.name,
        [helper.make_tensor_value_info(source.name, TensorProto.FLOAT, source.shape)],
        [helper.make_tensor_value_info(target.name, TensorProto.FLOAT, target.shape)],
        [numpy_helper.from_array(value, name) for name, value in (weights or {}).items()],
    )
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata)
    return model


def bytes_of(model):
    return model.SerializeToString()


def attacks(metadata):
    """What a network could hide: other files, loops, recursion, and sizes that are not there."""
    external = attractor(metadata)
    (weights,) = external.graph.initializer
    weights.ClearField("raw_data")
    weights.data_location = TensorProto.EXTERNAL
    weights.external_data.add(key="location", value="/etc/passwd")
    yield bytes_of(external)
    last = helper.make_node("Sigmoid", ["x"], ["attractor"])
    size = numpy_helper.from_array(np.array([2**14, 2**16], np.int64))
    yield bytes_of(attractor(metadata, [helper.make_node("ConstantOfShape", ["n"], ["x"]), last]))
    yield bytes_of(attractor(metadata, [helper.make_node("Constant", [], ["x"], value=size), last]))
    body = attractor(metadata).graph
    for operator in ("Loop", "Scan", "If", "Identity"):
        yield bytes_of(
            attractor(metadata, [helper.make_node(operator, ["a"], ["x"], body=body), last])
        )
    huge = attractor(metadata)
    huge.graph.initializer[0].dims[:] = [2**31, 2**31]
    yield bytes_of(huge)
    for value in ("[" * 100_000, '{"width":' + "9" * 5_000, '{"fx":1e999}', "null", "NaN", "\0"):
        yield bytes_of(attractor(metadata | {"cbe.camera": value[:4_000]}))
        yield bytes_of(attractor(metadata | {"cbe.segment_steps": value}))
        yield bytes_of(attractor(metadata | {"cbe.model_id": value}))
    nested = b""
    for _ in range(5_000):  # a graph in a node in a graph ...
        nested = b"\x3a" + bytes([0x80 | len(nested) & 0x7F, len(nested) >> 7 & 0x7F]) + nested
    yield nested
    whole = bytes_of(attractor(metadata))
    yield whole.replace(b"mixed", b"mi\x7f\xc0d")  # a name that is no text
    yield whole + whole  # protobuf merges the two
    yield b"\x0a\0" * 1_000_000
    yield b"\x08" + b"\xff" * 1_000
    yield b"\x3a\xff\xff\xff\xff\x7f"
    yield b"\0" * (MAX_FILE_BYTES + 1)


@pytest.fixture
def folder(tmp_path):
    for name in GRAPHS:
        (tmp_path / f"{name}.onnx").write_bytes((SHIPPED / f"{name}.onnx").read_bytes())
    return tmp_path


def test_hostile_header_is_refused_soon_and_small(fuzzed):
    """All that is read before onnxruntime sees a file."""
    small = bytes_of(attractor(METADATA))
    texts = [each.encode() for each in (*METADATA, *METADATA.values(), "If", "Loop", "Conv")]
    report = fuzzed(
        "models-header",
        modelheader.parse,
        [small],
        mutants([small], SEED, texts),
        attacks=attacks(METADATA),
    )
    assert 0 < report.accepted < report.inputs


def test_hostile_model_is_refused_soon_and_small(fuzzed, folder):
    """The attractor of a folder; whatever is accepted must also run, or say why not."""
    path = folder / "attractor.onnx"
    whole = onnx.load(path)
    features = np.zeros(signature.FEATURES, np.float32)

    def read(data):
        path.write_bytes(data)
        Networks.load(folder).attract(features)

    metadata = {each.key: each.value for each in whole.metadata_props}
    small = bytes_of(attractor(metadata))
    report = fuzzed(
        "models", read, [small], mutants([small], SEED), attacks=attacks(metadata), share=0.1
    )
    assert 0 < report.accepted < report.inputs


@pytest.mark.parametrize("name", GRAPHS)
def test_truncated_model_is_refused(folder, name):
    path = folder / f"{name}.onnx"
    whole = path.read_bytes()
    for share in (0.0, 0.001, 0.5, 0.999):
        path.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(ModelError):
            Networks.load(folder)


def test_folder_in_a_files_place_is_refused(folder):
    for name in reversed(GRAPHS):
        path = folder / f"{name}.onnx"
        path.unlink()
        path.mkdir()
        with pytest.raises(ModelError, match=name):
            Networks.load(folder)
