"""What an ONNX file says about itself, read from its protobuf before anything is built of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cbe.errors import ModelError
from cbe.signature import Tensor

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_FIELDS = 50_000
"""Protobuf fields of a file; ours have two thousand."""
MAX_TEXT_BYTES = 4096

_KNOWN = """
    Abs Add And Atan AveragePool BatchNormalization Cast Ceil Clip Concat Constant Conv
    ConvInteger Cos CumSum DequantizeLinear Div DynamicQuantizeLinear Elu Equal Erf Exp Flatten
    Floor GRU Gather Gelu Gemm GlobalAveragePool Greater GreaterOrEqual HardSigmoid HardSwish
    Identity InstanceNormalization LSTM LayerNormalization LeakyRelu Less LessOrEqual Log
    LogSoftmax MatMul MatMulInteger Max MaxPool Min Mul Neg Not Or PRelu Pow QLinearConv
    QLinearMatMul QuantizeLinear Reciprocal ReduceL2 ReduceMax ReduceMean ReduceMin ReduceSum
    Relu Reshape Round Shape Sigmoid Sign Sin Slice Softmax Softplus Split Sqrt Squeeze Sub Tanh
    Transpose Unsqueeze Where
"""
OPERATORS = frozenset(_KNOWN.split())
"""What a network of ours may be built of: no loops or choices, nothing that fills memory."""

_ELEMENTS = {1: "tensor(float)", 2: "tensor(uint8)"}
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # protobuf's wire types

# Numbers of the fields in use, from onnx.proto.
_MODEL_GRAPH, _MODEL_METADATA, _MODEL_TRAINING, _MODEL_FUNCTIONS = 7, 14, 20, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_INPUT, _GRAPH_OUTPUT, _GRAPH_SPARSE = 1, 5, 11, 12, 15
_NODE_OPERATOR, _NODE_ATTRIBUTE = 4, 5
_ATTRIBUTE_TENSOR, _ATTRIBUTE_GRAPH, _ATTRIBUTE_GRAPHS = 5, 6, 11
_TENSOR_EXTERNAL, _TENSOR_LOCATION = 13, 14
_VALUE_NAME, _VALUE_TYPE = 1, 2
_TYPE_TENSOR = 1
_TENSOR_ELEMENT, _TENSOR_SHAPE = 1, 2
_SHAPE_DIMENSION = 1
_DIMENSION_VALUE = 1
_ENTRY_KEY, _ENTRY_VALUE = 1, 2


@dataclass(frozen=True, slots=True)
class Header:
    """A graph's inputs and outputs in order, and the file's metadata; unknown sizes are -1."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: dict[str, str]


def parse(data: bytes) -> Header:
    """The header of an ONNX file.

    Raises:
        ModelError: the bytes are no ONNX, or hold what no model of ours does: functions,
            graphs within graphs, data in other files, other operators.
    """
    reader = _Reader()
    model = reader.message(memoryview(data))
    if model.of(_MODEL_FUNCTIONS) or model.of(_MODEL_TRAINING):
        raise _refusal("it holds functions or training graphs")
    graph = reader.message(model.one(_MODEL_GRAPH))
    _check_graph(reader, graph)
    entries = [reader.message(entry) for entry in model.of(_MODEL_METADATA)]
    metadata = {entry.text(_ENTRY_KEY): entry.text(_ENTRY_VALUE) for entry in entries}
    if len(metadata) != len(entries):
        raise _refusal("its metadata has a key twice")
    return Header(
        tuple(_tensor(reader, value) for value in graph.of(_GRAPH_INPUT)),
        tuple(_tensor(reader, value) for value in graph.of(_GRAPH_OUTPUT)),
        metadata,
    )


def _check_graph(reader: _Reader, graph: _Message) -> None:
    """Refuse what no model of ours holds."""
    for node in map(reader.message, graph.of(_GRAPH_NODE)):
        operator = node.text(_NODE_OPERATOR)
        if operator not in OPERATORS:
            raise _refusal(
                f"it has an operator {operator[:40]!r}; known: {', '.join(sorted(OPERATORS))}"
            )
        for attribute in map(reader.message, node.of(_NODE_ATTRIBUTE)):
            if attribute.of(_ATTRIBUTE_GRAPH) or attribute.of(_ATTRIBUTE_GRAPHS):
                raise _refusal(f"its {operator} holds a graph of its own")
            for tensor in attribute.of(_ATTRIBUTE_TENSOR):
                _check_weights(reader.message(tensor))
    if graph.of(_GRAPH_SPARSE):
        raise _refusal("it holds sparse weights")
    for tensor in graph.of(_GRAPH_INITIALIZER):
        _check_weights(reader.message(tensor))


def _check_weights(tensor: _Message) -> None:
    if tensor.of(_TENSOR_EXTERNAL) or any(tensor.numbers(_TENSOR_LOCATION)):
        raise _refusal("its weights are in another file")


def _tensor(reader: _Reader, value: memoryview) -> Tensor:
    info = reader.message(value)
    declared = reader.message(reader.message(info.one(_VALUE_TYPE)).one(_TYPE_TENSOR))
    shape = reader.message(declared.one(_TENSOR_SHAPE))
    sizes = [reader.message(each).numbers(_DIMENSION_VALUE) for each in shape.of(_SHAPE_DIMENSION)]
    element = (*declared.numbers(_TENSOR_ELEMENT), 0)[0]
    return Tensor(
        info.text(_VALUE_NAME),
        tuple(size[0] if len(size) == 1 else -1 for size in sizes),
        _ELEMENTS.get(element, f"element type {element}"),
    )


class _Message:
    """The fields of one protobuf message by number, in order; nothing within them is read yet."""

    def __init__(self, fields: Iterator[tuple[int, int | memoryview]]) -> None:
        self._parts: dict[int, list[memoryview]] = {}
        self._numbers: dict[int, list[int]] = {}
        for number, value in fields:
            if isinstance(value, int):
                self._numbers.setdefault(number, []).append(value)
            else:
                self._parts.setdefault(number, []).append(value)

    def of(self, number: int) -> list[memoryview]:
        return self._parts.get(number, [])

    def numbers(self, number: int) -> list[int]:
        return self._numbers.get(number, [])

    def one(self, number: int) -> memoryview:
        """The only part of that number: of several, readers would differ on which counts."""
        parts = self.of(number)
        if len(parts) != 1:
            raise _refusal(f"it has {len(parts)} parts where one is expected")
        return parts[0]

    def text(self, number: int) -> str:
        part = self.one(number)
        if len(part) > MAX_TEXT_BYTES:
            raise _refusal(f"it has a text of {len(part)} bytes")
        try:
            return str(part, "utf-8")
        except UnicodeDecodeError as error:
            raise _refusal(str(error)) from error


class _Reader:
    """Reads messages of one file, up to `MAX_FIELDS` in all."""

    def __init__(self) -> None:
        self._left = MAX_FIELDS

    def message(self, data: memoryview) -> _Message:
        return _Message(self._fields(data))

    def _fields(self, data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
        at = 0
        while at < len(data):
            self._left -= 1
            if self._left < 0:
                raise _refusal(f"it has more than {MAX_FIELDS} parts")
            key, at = _varint(data, at)
            number, kind = key >> 3, key & 7
            if kind == _VARINT:
                value, at = _varint(data, at)
                yield number, value
                continue
            if kind == _BYTES:
                size, at = _varint(data, at)
            elif kind in (_FIXED32, _FIXED64):
                size = 4 if kind == _FIXED32 else 8
            else:
                raise _refusal(f"it has a part of unknown kind {kind}")
            at += size
            if at > len(data):
                raise _refusal(f"it ends within a part of {size} bytes")
            if kind == _BYTES:
                yield number, data[at - size : at]


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """A number of 7 bits a byte, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise _refusal("it ends within a number")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise _refusal("it has a number of more than 64 bits")


def _refusal(found: str) -> ModelError:
    return ModelError(f"no usable ONNX file of ours: {found}; export the model again")
