"""What is refused of an ONNX file before onnxruntime sees it."""

import onnx
import pytest
from onnx import TensorProto, helper

from cbe.errors import ModelError
from cbe_runtime import modelheader
from cbe_runtime.modelfile import ModelFile
from cbe_runtime.networks import Networks


@pytest.fixture
def model(model_folder):
    return onnx.load(model_folder / "attractor.onnx")


def other_file(model):
    (weights, *_) = model.graph.initializer
    weights.ClearField("raw_data")
    weights.data_location = TensorProto.EXTERNAL
    weights.external_data.add(key="location", value="/etc/passwd")


def other_file_in_a_constant(model):
    node = helper.make_node("Constant", [], ["x"], value=helper.make_tensor("x", 1, [1], [0.0]))
    node.attribute[0].t.external_data.add(key="location", value="weights")
    model.graph.node.append(node)


def loop(model):
    model.graph.node[0].op_type = "Loop"


def choice(model):
    model.graph.node[0].op_type = "If"


def memory(model):
    model.graph.node[0].op_type = "ConstantOfShape"


def subgraph(model):
    attribute = helper.make_attribute(
        "body", onnx.load_from_string(model.SerializeToString()).graph
    )
    model.graph.node[0].attribute.append(attribute)


def function(model):
    model.functions.add().name = "f"


def sparse(model):
    model.graph.sparse_initializer.add()


def same_key(model):
    model.metadata_props.append(model.metadata_props[0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (other_file, "another file"),
        (other_file_in_a_constant, "another file"),
        (loop, "operator 'Loop'"),
        (choice, "operator 'If'"),
        (memory, "operator 'ConstantOfShape'"),
        (subgraph, "graph of its own"),
        (function, "functions"),
        (sparse, "sparse"),
        (same_key, "twice"),
    ],
)
def test_what_no_model_of_ours_holds_is_refused(model, change, reason):
    modelheader.parse(model.SerializeToString())
    change(model)
    with pytest.raises(ModelError, match=reason):
        modelheader.parse(model.SerializeToString())


def test_two_graphs_that_readers_would_merge_are_refused(model):
    whole = model.SerializeToString()
    with pytest.raises(ModelError, match="2 parts where one"):
        modelheader.parse(whole + whole)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "0 parts"),
        (b"\x3a\xff\xff\xff\xff\x7f", "ends within a part"),
        (b"\x3a\xff", "ends within a number"),
        (b"\x08" + b"\xff" * 11, "more than 64 bits"),
        (b"\x0b", "unknown kind"),
        (b"\x0a\0" * (modelheader.MAX_FIELDS + 1), "parts"),
    ],
)
def test_bytes_that_are_no_protobuf_are_refused(data, reason):
    with pytest.raises(ModelError, match=reason):
        modelheader.parse(data)


def test_header_says_what_onnxruntime_says(model_folder):
    import onnxruntime

    for path in model_folder.glob("*.onnx"):
        header = ModelFile.read(path).header
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        for found, nodes in (
            (header.inputs, session.get_inputs()),
            (header.outputs, session.get_outputs()),
        ):
            assert [(each.name, list(each.shape), each.dtype) for each in found] == [
                (node.name, node.shape, node.type) for node in nodes
            ]
        assert header.metadata == session.get_modelmeta().custom_metadata_map


def test_unreadable_name_in_a_graph_is_a_model_error(tmp_path, model_writer):
    """onnxruntime quotes it in a message that Python cannot decode."""
    path = model_writer(tmp_path) / "attractor.onnx"
    path.write_bytes(path.read_bytes().replace(b"mixed", b"mi\x7f\xc0d", 1))
    with pytest.raises(ModelError, match=r"attractor\.onnx"):
        Networks.load(tmp_path)
