"""ONNX files opened and held against the signature before anything is run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from cbe import signature
from cbe.camera import CameraModel
from cbe.errors import CameraError, ModelError

if TYPE_CHECKING:
    from pathlib import Path

MAX_FILE_BYTES = 200 * 2**20
"""Far above the shipped files, so that a wrong file is refused before onnxruntime parses it."""

# onnxruntime raises these, each derived from Exception alone.
ORT_FAULTS = (
    ort_errors.EPFail,
    ort_errors.EngineError,
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NoModel,
    ort_errors.NoSuchFile,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
)


@dataclass(frozen=True, slots=True)
class Metadata:
    """The values under `signature.METADATA_KEYS`, parsed."""

    model_id: str
    network_period: int
    camera: CameraModel
    segment_steps: int
    precision: str


def open_session(path: Path) -> ort.InferenceSession:
    """A session on one ONNX file: one thread, sequential, no spinning.

    Raises:
        ModelError: the file is missing, too large or no ONNX.
    """
    if not path.is_file():
        raise ModelError(f"no {path.name} in {path.parent}; give a folder with the three networks")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ModelError(
            f"{path} has {size} bytes, more than {MAX_FILE_BYTES}; is it the right file?"
        )
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    # A spinning pool burns most of a core between two ticks of 100 ms.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 3  # errors reach the user as ModelError
    try:
        return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except ORT_FAULTS as fault:
        raise ModelError(
            f"{path} is no usable ONNX file ({fault}); export the model again"
        ) from fault


def state_size(session: ort.InferenceSession) -> int:
    """Width of the recurrent state, the one size the signature leaves open; 0 if none is stated."""
    shapes = [node.shape for node in session.get_inputs() if node.name == "h"]
    width = shapes[0][-1] if shapes and shapes[0] else 0
    return width if isinstance(width, int) else 0


def check_graph(session: ort.InferenceSession, graph: signature.Graph) -> None:
    """Hold a session's inputs and outputs against the signature's.

    Raises:
        ModelError: a name, shape or type differs.
    """
    for side, nodes, tensors in (
        ("inputs", session.get_inputs(), graph.inputs),
        ("outputs", session.get_outputs(), graph.outputs),
    ):
        found = [signature.Tensor(node.name, tuple(node.shape), node.type) for node in nodes]
        if found != list(tensors):
            raise ModelError(
                f"{graph.name}.onnx has {side} {_listed(found)}, expected {_listed(tensors)}; "
                "export it again with this version"
            )


def _listed(tensors: list[signature.Tensor] | tuple[signature.Tensor, ...]) -> str:
    return ", ".join(f"{tensor.name}{list(tensor.shape)} {tensor.dtype}" for tensor in tensors)


def read_metadata(session: ort.InferenceSession) -> Metadata:
    """The metadata of a session's file.

    Raises:
        ModelError: a key is missing or a value out of range.
    """
    stored = session.get_modelmeta().custom_metadata_map
    missing = [key for key in signature.METADATA_KEYS if key not in stored]
    if missing:
        raise ModelError(f"the model lacks metadata {', '.join(missing)}; export it again")
    version = stored["cbe.contract_version"]
    if version != str(signature.CONTRACT_VERSION):
        raise ModelError(
            f"the model has contract version {version}, expected {signature.CONTRACT_VERSION}; "
            "export it again with this version"
        )
    try:
        metadata = Metadata(
            model_id=stored["cbe.model_id"],
            network_period=int(stored["cbe.network_period"]),
            camera=CameraModel.from_dict(json.loads(stored["cbe.camera"])),
            segment_steps=int(stored["cbe.segment_steps"]),
            precision=stored["cbe.precision"],
        )
        known_id = len(bytes.fromhex(metadata.model_id)) == 8
    except (ValueError, CameraError) as error:
        raise ModelError(f"the model's metadata is damaged ({error}); export it again") from error
    if not known_id or metadata.network_period not in (1, 2) or metadata.segment_steps < 1:
        raise ModelError(
            f"the model's metadata is out of range (model_id {metadata.model_id}, network_period "
            f"{metadata.network_period}, segment_steps {metadata.segment_steps}); export it again"
        )
    return metadata
