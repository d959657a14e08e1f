"""Tiny random networks in ONNX that keep to the signature, made once a session."""

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from cbe import signature
from cbe_runtime.networks import Networks
from cbe_runtime.route import Precision, Route, Segment

ELEMENTS = {"tensor(float)": TensorProto.FLOAT, "tensor(uint8)": TensorProto.UINT8}
STATE = 8


def infos(tensors):
    return [helper.make_tensor_value_info(t.name, ELEMENTS[t.dtype], t.shape) for t in tensors]


def write(folder, graph, nodes, weights, **metadata):
    constants = [numpy_helper.from_array(value, name) for name, value in weights.items()]
    body = helper.make_graph(
        nodes, graph.name, infos(graph.inputs), infos(graph.outputs), initializer=constants
    )
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    stored = {
        "cbe.contract_version": str(signature.CONTRACT_VERSION),
        "cbe.model_id": "00112233445566aa",
        "cbe.network_period": "2",
        "cbe.camera": json.dumps(
            {
                "width": 64,
                "height": 64,
                "fx": 18.48,
                "fy": 23.68,
                "cx": 32.0,
                "cy": 32.0,
                "model": "pinhole",
                "distortion": [],
            }
        ),
        "cbe.segment_steps": "40",
        "cbe.precision": "fp32",
    } | metadata
    helper.set_model_props(model, {k: v for k, v in stored.items() if v is not None})
    onnx.checker.check_model(model)
    onnx.save(model, folder / f"{graph.name}.onnx")


def encoder_nodes(rng):
    """Features are a pooled image; the state counts frames; z is the mean of the image."""
    weights = {
        "scale": np.float32([1 / 255]),
        "one": np.float32([1.0]),
        "spread": rng.normal(size=(signature.FEATURES[0], 3, 1, 1)).astype(np.float32),
        "to_z": rng.normal(size=(STATE, signature.EMBEDDING_SIZE)).astype(np.float32),
    }
    nodes = [
        helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["float", "scale"], ["unit"]),
        helper.make_node("Transpose", ["unit"], ["nchw"], perm=[0, 3, 1, 2]),
        helper.make_node("AveragePool", ["nchw"], ["pooled"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Conv", ["pooled", "spread"], ["features"]),
        helper.make_node("Add", ["state", "one"], ["state_next"]),
        helper.make_node("MatMul", ["state_next", "to_z"], ["embedding"]),
    ]
    return nodes, weights


def attractor_nodes(rng):
    weights = {
        "mix": rng.normal(size=(signature.FEATURES[0], signature.ATTRACTOR_SIZE)).astype(np.float32)
    }
    nodes = [
        helper.make_node("ReduceMean", ["features"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("MatMul", ["mean", "mix"], ["mixed"]),
        helper.make_node("Sigmoid", ["mixed"], ["attractor"]),
    ]
    return nodes, weights


def recall_nodes():
    """What is recalled is the behavior's embedding."""
    graph = signature.recall(signature.EMBEDDING_SIZE)
    attractors = [t.name for t in graph.inputs[:3]]
    nodes = [
        helper.make_node("Concat", attractors, ["all"], axis=1),
        helper.make_node("ReduceMean", ["all"], ["used"], axes=[1]),
        helper.make_node("Mul", ["used", "zero"], ["nothing"]),
        helper.make_node("Add", ["embedding_goal", "nothing"], ["recalled"]),
    ]
    return graph, nodes, {"zero": np.float32([0.0])}


def generator_nodes(ticks_to_goal, waypoint_m):
    """Progress counts ticks since the behavior began; the waypoint is always straight ahead.

    It is always sure to be on the route, and sees the end come nearer until progress is 1.
    """
    weights = {
        "one": np.float32([[1.0]]),
        "rate": np.full((STATE, 1), 1.0 / STATE / ticks_to_goal, np.float32),
        "ahead": np.float32([list(waypoint_m)]),
        "end_pose": np.float32([[0.0, waypoint_m[1], 1.0, 0.0]]),
        "left": np.float32([[4.0, 0.0, 0.0, 0.0]]),
        "zero": np.float32([0.0]),
        "sure": np.float32([5.0]),
    }
    graph = signature.generator(STATE, signature.EMBEDDING_SIZE)
    inputs = [t.name for t in graph.inputs[:3]]
    nodes = [
        helper.make_node("Add", ["state", "one"], ["state_next"]),
        helper.make_node("MatMul", ["state_next", "rate"], ["progress"]),
        helper.make_node("Concat", inputs, ["all"], axis=1),
        helper.make_node("ReduceMean", ["all"], ["used"], axes=[1]),
        helper.make_node("Mul", ["used", "zero"], ["nothing"]),
        helper.make_node("Add", ["ahead", "nothing"], ["waypoint_m"]),
        helper.make_node("Sub", ["one", "progress"], ["undone"]),
        helper.make_node("Relu", ["undone"], ["still_undone"]),
        helper.make_node("Mul", ["still_undone", "left"], ["farther"]),
        helper.make_node("Add", ["end_pose", "farther"], ["farther_end"]),
        helper.make_node("Add", ["farther_end", "nothing"], ["end"]),
        helper.make_node("Add", ["nothing", "sure"], ["on_route_logit"]),
        helper.make_node("Sigmoid", ["on_route_logit"], ["on_route"]),
    ]
    return graph, nodes, weights


def make_model(folder, ticks_to_goal=19.5, waypoint_m=(0.5, 0.0), **metadata):
    """Write a tiny model whose progress rises by 1/ticks_to_goal a tick."""
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    write(folder, signature.encoder(STATE), *encoder_nodes(rng), **metadata)
    write(folder, signature.attractor(), *attractor_nodes(rng), **metadata)
    write(folder, *recall_nodes(), **metadata)
    write(folder, *generator_nodes(ticks_to_goal, waypoint_m), **metadata)
    return folder


def write_shape(folder, path_m, **metadata):
    """Write a shape.onnx that reads the same path (8, 2) off every embedding."""
    weights = {"zero": np.float32([0.0]), "path": np.float32(path_m)[None]}
    nodes = [
        helper.make_node("ReduceMean", ["embedding"], ["mean"], axes=[0, 1], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["path", "nothing"], ["path_m"]),
    ]
    write(folder, signature.shape(), nodes, weights, **metadata)
    return folder


@pytest.fixture(scope="session")
def shape_writer():
    return write_shape


@pytest.fixture(scope="session")
def model_folder(tmp_path_factory) -> Path:
    return make_model(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="session")
def networks(model_folder) -> Networks:
    return Networks.load(model_folder)


@pytest.fixture(scope="session")
def model_writer():
    return make_model


@pytest.fixture
def route(networks) -> Route:
    """Two segments of 30 steps, the end of which looks plain grey."""
    rng = np.random.default_rng(1)
    precision = Precision()
    grey = np.full((64, 64, 3), 90, np.uint8)
    end = networks.attract(networks.encode(grey, networks.encoder_state())[0])
    return Route(
        model_id=networks.model_id,
        camera=networks.camera,
        network_period=networks.network_period,
        precision=precision,
        attractors=tuple(
            precision.attractor.pack(each)
            for each in (*rng.random((2, signature.ATTRACTOR_SIZE), np.float32), end)
        ),
        segments=tuple(
            Segment(precision.embedding.pack(rng.random(signature.EMBEDDING_SIZE, np.float32)), 30)
            for _ in range(2)
        ),
        tags={"name": "hall"},
    )
