"""The three ONNX graphs behind one checked, typed interface (paper, Sec. III-B to III-D)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime as ort
from cbe import signature
from cbe.camera import CameraModel
from cbe.errors import CameraError, ModelError
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

if TYPE_CHECKING:
    from numpy.typing import NDArray

PACKAGED_MODELS = Path(__file__).parent / "models"
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
class EncoderState:
    """What the encoder carries from one network frame to the next.

    `features` (1, *FEATURES), `h` and `c` (1, state) float32; `is_first` (1,) is 1 until the
    behavior's first frame has been seen.
    """

    features: NDArray[np.float32]
    is_first: NDArray[np.float32]
    h: NDArray[np.float32]
    c: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class GeneratorState:
    """The waypoint generator's recurrent state: `h` and `c` (1, state) float32."""

    h: NDArray[np.float32]
    c: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Prediction:
    """One tick of the generator.

    `waypoint_m` (2,) float64 in base_link; `progress` from 0 to 1 over the behavior (not
    clipped); `on_route` the probability of being within 1 m of the demonstration.
    """

    waypoint_m: NDArray[np.float64]
    progress: float
    on_route: float


@dataclass(frozen=True, slots=True)
class _Metadata:
    """The values under `signature.METADATA_KEYS`, parsed."""

    model_id: str
    network_period: int
    camera: CameraModel
    segment_steps: int
    precision: str


class Networks:
    """Encoder, attractor and generator of one model, one thread each, checked before use."""

    def __init__(
        self,
        encoder: ort.InferenceSession,
        attractor: ort.InferenceSession,
        generator: ort.InferenceSession,
        metadata: _Metadata,
    ) -> None:
        self._encoder = encoder
        self._attractor = attractor
        self._generator = generator
        self._metadata = metadata
        self._encoder_size = _state_size(encoder)
        self._generator_size = _state_size(generator)
        self._first_state = EncoderState(
            np.zeros((1, *signature.FEATURES), np.float32),
            np.ones(1, np.float32),
            *_zero_state(self._encoder_size),
        )
        self._first_generator_state = GeneratorState(*_zero_state(self._generator_size))
        self._not_first = np.zeros(1, np.float32)

    @classmethod
    def load(cls, folder: Path = PACKAGED_MODELS) -> Networks:
        """Open `encoder.onnx`, `attractor.onnx` and `generator.onnx` of `folder`.

        Raises:
            ModelError: a file is missing, too large or no ONNX; names, shapes or types differ
                from `cbe.signature`; metadata is missing; or the three are of different models.
        """
        sessions = [_open(folder / f"{name}.onnx") for name in ("encoder", "attractor", "generator")]
        encoder, attractor, generator = sessions
        _check_graph(encoder, signature.encoder(_state_size(encoder)))
        _check_graph(attractor, signature.attractor())
        _check_graph(generator, signature.generator(_state_size(generator)))
        parsed = [_metadata(session) for session in sessions]
        if any(other != parsed[0] for other in parsed):
            ids = ", ".join(each.model_id for each in parsed)
            raise ModelError(
                f"the encoder, attractor and generator in {folder} are of different models "
                f"({ids}); export all three from one checkpoint"
            )
        return cls(encoder, attractor, generator, parsed[0])

    @property
    def model_id(self) -> str:
        """16 hex digits naming weights, preprocessing and quantisation."""
        return self._metadata.model_id

    @property
    def network_period(self) -> int:
        """Steps between two network ticks."""
        return self._metadata.network_period

    @property
    def camera(self) -> CameraModel:
        """The view the model was trained on."""
        return self._metadata.camera

    @property
    def segment_steps(self) -> int:
        """K: the longest behavior, in steps, that the model repeats well."""
        return self._metadata.segment_steps

    @property
    def precision(self) -> str:
        """`fp32` or `int8`."""
        return self._metadata.precision

    def encoder_state(self) -> EncoderState:
        """The state before a behavior's first frame."""
        return self._first_state

    def generator_state(self) -> GeneratorState:
        """The state before a behavior's first tick."""
        return self._first_generator_state

    def encode(
        self, image: NDArray[np.uint8], state: EncoderState
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], EncoderState]:
        """See one frame.

        Args:
            image: (64, 64, 3) uint8 RGB, the model's view.
            state: of the previous network frame, or `encoder_state()` on a behavior's first.

        Returns:
            features (1, *FEATURES), embedding z (32,) of the frames since the first, next state.

        Raises:
            ModelError: an output is not finite.
        """
        features, embedding, h, c = self._run(
            self._encoder,
            "encoder",
            {
                "image": image[None],  # (1, 64, 64, 3)
                "previous_features": state.features,
                "is_first": state.is_first,
                "h": state.h,
                "c": state.c,
            },
        )
        return features, embedding[0], EncoderState(features, self._not_first, h, c)

    def attract(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Attractor (400,) of the frame whose features (1, *FEATURES) these are.

        Raises:
            ModelError: an output is not finite.
        """
        (attractor,) = self._run(self._attractor, "attractor", {"features": features})
        return attractor[0]

    def generate(
        self,
        *,
        attractor_now: NDArray[np.float32],
        attractor_first: NDArray[np.float32],
        attractor_start: NDArray[np.float32],
        attractor_goal: NDArray[np.float32],
        embedding_now: NDArray[np.float32],
        embedding_goal: NDArray[np.float32],
        state: GeneratorState,
    ) -> tuple[Prediction, GeneratorState]:
        """Where to go next on the behavior from `attractor_start` to `attractor_goal`.

        Attractors are (400,) float32: now, at the repetition's first frame of this behavior,
        and the demonstration's two; embeddings are (32,).

        Raises:
            ModelError: an output is not finite.
        """
        waypoint_m, progress, on_route, h, c = self._run(
            self._generator,
            "generator",
            {
                "attractor_now": attractor_now[None],
                "attractor_first": attractor_first[None],
                "attractor_start": attractor_start[None],
                "attractor_goal": attractor_goal[None],
                "embedding_now": embedding_now[None],
                "embedding_goal": embedding_goal[None],
                "h": state.h,
                "c": state.c,
            },
        )
        prediction = Prediction(
            waypoint_m[0].astype(np.float64), float(progress[0]), float(on_route[0])
        )
        return prediction, GeneratorState(h, c)

    @staticmethod
    def _run(
        session: ort.InferenceSession, name: str, inputs: dict[str, NDArray[Any]]
    ) -> list[NDArray[np.float32]]:
        try:
            outputs: list[NDArray[np.float32]] = session.run(None, inputs)
        except ORT_FAULTS as fault:
            raise ModelError(f"the {name} network failed: {fault}") from fault
        # Any inf or NaN makes the sum of squares non-finite: one pass, no temporary mask.
        if not all(np.isfinite(np.vdot(output, output)) for output in outputs):
            raise ModelError(f"the {name} network put out a value that is not finite; stop and check it")
        return outputs


def _zero_state(size: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    zeros = np.zeros((1, size), np.float32)
    return zeros, zeros


def _open(path: Path) -> ort.InferenceSession:
    if not path.is_file():
        raise ModelError(f"no {path.name} in {path.parent}; give a folder with the three networks")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ModelError(f"{path} has {size} bytes, more than {MAX_FILE_BYTES}; is it the right file?")
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
        raise ModelError(f"{path} is no usable ONNX file ({fault}); export the model again") from fault


def _state_size(session: ort.InferenceSession) -> int:
    """Width of the recurrent state, the one size the signature leaves open; 0 if none is stated."""
    shapes = [node.shape for node in session.get_inputs() if node.name == "h"]
    width = shapes[0][-1] if shapes and shapes[0] else 0
    return width if isinstance(width, int) else 0


def _check_graph(session: ort.InferenceSession, graph: signature.Graph) -> None:
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


def _metadata(session: ort.InferenceSession) -> _Metadata:
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
        metadata = _Metadata(
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
