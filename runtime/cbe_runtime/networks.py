"""The ONNX graphs behind one checked, typed interface (paper, Sec. III-B to III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import onnxruntime as ort

from cbe import signature
from cbe.errors import ModelError
from cbe_runtime.graph import Graph
from cbe_runtime.modelfile import (
    ModelFile,
    check_graph,
    open_session,
    read_metadata,
    state_size,
)
from cbe_runtime.pathshape import PathShape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe.camera import CameraModel
    from cbe_runtime.modelfile import Metadata

PACKAGED_MODELS = Path(__file__).parent / "models"


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
    clipped); `on_route` the probability of being within 1 m of the demonstration. `end` (4,)
    float64 is x, y in m, cos and sin of the behavior's last pose in base_link as the view shows
    it: precise (0.1 m, 2 deg) near the end, anything where the end is out of sight.
    """

    waypoint_m: NDArray[np.float64]
    progress: float
    on_route: float
    end: NDArray[np.float64]


class Networks:
    """Encoder, attractor and generator of one model, one thread each, checked before use."""

    def __init__(
        self,
        encoder: ort.InferenceSession,
        attractor: ort.InferenceSession,
        generator: ort.InferenceSession,
        metadata: Metadata,
        shape: PathShape | None = None,
    ) -> None:
        self._encoder = encoder = Graph(encoder, "encoder")
        self._attractor = Graph(attractor, "attractor")
        self._generator = generator = Graph(generator, "generator")
        self._metadata = metadata
        self._shape = shape
        self._first_state = EncoderState(
            encoder.zeros("previous_features"),
            np.ones(1, np.float32),
            encoder.zeros("h"),
            encoder.zeros("c"),
        )
        self._first_generator_state = GeneratorState(generator.zeros("h"), generator.zeros("c"))
        self._not_first = np.zeros(1, np.float32)

    @classmethod
    def load(cls, folder: Path = PACKAGED_MODELS) -> Networks:
        """Open `encoder.onnx`, `attractor.onnx` and `generator.onnx` of `folder`.

        All is checked before anything is built. `shape.onnx` is opened where there is one.

        Raises:
            ModelError: a file is missing, too large or no ONNX; names, shapes or types differ
                from `cbe.signature`; metadata is missing; or they are of different models.
        """
        files = [
            ModelFile.read(folder / f"{name}.onnx")
            for name in ("encoder", "attractor", "generator")
        ]
        encoder, attractor, generator = files
        check_graph(encoder, signature.encoder(state_size(encoder)))
        check_graph(attractor, signature.attractor())
        check_graph(generator, signature.generator(state_size(generator)))
        parsed = [read_metadata(file) for file in files]
        if any(other != parsed[0] for other in parsed):
            ids = ", ".join(each.model_id for each in parsed)
            raise ModelError(
                f"the encoder, attractor and generator in {folder} are of different models "
                f"({ids}); export all three from one checkpoint"
            )
        shape = PathShape.load(folder) if PathShape.there(folder) else None
        if shape is not None and shape.model_id != parsed[0].model_id:
            raise ModelError(
                f"in {folder} shape.onnx is of model {shape.model_id}, the others are of "
                f"{parsed[0].model_id}; export all from one checkpoint, or delete shape.onnx"
            )
        return cls(
            open_session(encoder),
            open_session(attractor),
            open_session(generator),
            parsed[0],
            shape,
        )

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
        features, embedding, h, c = self._encoder.run(
            {
                "image": image[None],  # (1, 64, 64, 3)
                "previous_features": state.features,
                "is_first": state.is_first,
                "h": state.h,
                "c": state.c,
            },
        )
        return features, embedding.reshape(-1), EncoderState(features, self._not_first, h, c)

    def attract(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Attractor (400,) of the frame whose features (1, *FEATURES) these are.

        Raises:
            ModelError: an output is not finite.
        """
        attractor: NDArray[np.float32]
        (attractor,) = self._attractor.run({"features": features})
        return attractor.reshape(-1)  # (1, 400) to (400,)

    def path_m(self, embedding: NDArray[np.float32]) -> NDArray[np.float64] | None:
        """Points (8, 2) as `PathShape.read`, or None if the model does not tell.

        Raises:
            ModelError: an output is not finite.
        """
        return None if self._shape is None else self._shape.read(embedding)

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
        waypoint_m, progress, on_route, end, h, c = self._generator.run(
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
            waypoint_m[0].astype(np.float64),
            float(progress[0]),
            float(on_route[0]),
            end[0].astype(np.float64),
        )
        return prediction, GeneratorState(h, c)
