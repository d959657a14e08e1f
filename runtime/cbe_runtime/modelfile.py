"""ONNX files opened and held against the signature before anything is run."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from cbe import signature
from cbe.camera import CameraModel
from cbe.errors import CameraError, ModelError
from cbe_runtime import modelheader

if TYPE_CHECKING:
    from pathlib import Path

MAX_FILE_BYTES = 48 * 2**20
"""Far above the shipped files; a wrong file is refused before it is read."""
MAX_OPEN_SIZE = 1 << 18
"""Numbers of a state; the largest of ours has 27,000."""
MAX_SEGMENT_STEPS = 1_000_000

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
    UnicodeDecodeError,  # its message quotes a name of the file's that is no text
)


@dataclass(frozen=True, slots=True)
class Metadata:
    """The values under `signature.METADATA_KEYS`, parsed."""

    model_id: str
    network_period: int
    camera: CameraModel
    segment_steps: int
    precision: str


@dataclass(frozen=True, slots=True)
class ModelFile:
    """One ONNX file and what it says about itself."""

    path: Path
    header: modelheader.Header

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file and its header.

        Raises:
            ModelError: the file is missing, too large, no ONNX, or holds what no model of ours
                does.
        """
        try:
            with path.open("rb") as file:
                data = file.read(MAX_FILE_BYTES + 1)
        except FileNotFoundError as error:
            raise ModelError(
                f"no {path.name} in {path.parent}; give a folder with a model's networks, "
                "exported with this version"
            ) from error
        except OSError as error:
            raise ModelError(f"cannot read {path}: {error.strerror}; check the file") from error
        if len(data) > MAX_FILE_BYTES:
            raise ModelError(f"{path} has more than {MAX_FILE_BYTES} bytes; is it the right file?")
        try:
            return cls(path, modelheader.parse(data))
        except ModelError as error:
            raise ModelError(f"{path} is {error}") from error


def open_session(file: ModelFile) -> ort.InferenceSession:
    """A session on one ONNX file: one thread, sequential, no spinning.

    Raises:
        ModelError: onnxruntime cannot build it.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    # A spinning pool burns most of a core between two ticks of 100 ms.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    # Weights side by side, not in an arena's chunks: a tick with cold caches takes 8 % less.
    options.add_session_config_entry("session.use_device_allocator_for_initializers", "1")
    options.log_severity_level = 3  # errors reach the user as ModelError
    try:
        return ort.InferenceSession(str(file.path), options, providers=["CPUExecutionProvider"])
    except ORT_FAULTS as fault:
        raise ModelError(
            f"{file.path} is no usable ONNX file ({str(fault)[:300]}); export the model again"
        ) from fault


def open_size(file: ModelFile, name: str) -> int:
    """Width of an input that the signature leaves open; 0 if none is stated, or too large a one."""
    shapes = [tensor.shape for tensor in file.header.inputs if tensor.name == name]
    width = shapes[0][-1] if shapes and shapes[0] else 0
    return width if 0 < width <= MAX_OPEN_SIZE else 0


def check_graph(file: ModelFile, graph: signature.Graph) -> None:
    """Hold a file's inputs and outputs against the signature's.

    Raises:
        ModelError: a name, shape or type differs.
    """
    for side, found, tensors in (
        ("inputs", file.header.inputs, graph.inputs),
        ("outputs", file.header.outputs, graph.outputs),
    ):
        if found != tensors:
            raise ModelError(
                f"{graph.name}.onnx has {side} {_listed(found)}, expected {_listed(tensors)}; "
                "export it again with this version"
            )


def _listed(tensors: tuple[signature.Tensor, ...]) -> str:
    listed = [f"{each.name[:40]}{list(each.shape[:6])} {each.dtype}" for each in tensors[:10]]
    return ", ".join(listed) or "none"


def read_metadata(file: ModelFile) -> Metadata:
    """The metadata of a file.

    Raises:
        ModelError: a key is missing or a value out of range.
    """
    stored = file.header.metadata
    missing = [key for key in signature.METADATA_KEYS if key not in stored]
    if missing:
        raise ModelError(f"the model lacks metadata {', '.join(missing)}; export it again")
    version = stored["cbe.contract_version"]
    if version != str(signature.CONTRACT_VERSION):
        raise ModelError(
            f"the model has contract version {version[:20]}, expected "
            f"{signature.CONTRACT_VERSION}; export it again with this version"
        )
    try:
        metadata = Metadata(
            model_id=stored["cbe.model_id"],
            network_period=int(stored["cbe.network_period"]),
            camera=CameraModel.from_dict(json.loads(stored["cbe.camera"])),
            segment_steps=int(stored["cbe.segment_steps"]),
            precision=stored["cbe.precision"],
        )
    except (ValueError, TypeError, AttributeError, RecursionError, CameraError) as error:
        raise ModelError(
            f"the model's metadata is damaged ({str(error)[:300]}); export it again"
        ) from error
    if (
        not re.fullmatch("[0-9a-f]{16}", metadata.model_id)
        or metadata.network_period not in (1, 2)
        or not 1 <= metadata.segment_steps <= MAX_SEGMENT_STEPS
    ):
        raise ModelError(
            f"the model's metadata is out of range (model_id {metadata.model_id[:20]}, "
            f"network_period {stored['cbe.network_period'][:20]}, segment_steps "
            f"{stored['cbe.segment_steps'][:20]}); export it again"
        )
    return metadata
