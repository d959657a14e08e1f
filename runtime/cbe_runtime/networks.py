"""The ONNX graphs behind one checked, typed interface (paper, Sec. III-B to III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import onnxruntime as ort

from cbe import signature
from cbe.errors import ModelError
from cbe_runtime.graph import Graph
from cbe_runtime.modelfile import (
    ModelFile,
    check_graph,
    open_session,
    open_size,
    read_metadata,
)
from cbe_runtime.pathshape import PathShape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe.camera import CameraModel
    from cbe_runtime.modelfile import Metadata

GRAPHS = ("encoder", "attractor", "recall", "generator")
PACKAGED_MODELS = Path(__file__).parent / "models"


class GeneratorState(NamedTuple):
    """What the waypoint generator carries through one behavior, both (size,) float32.

    `recalled` is worked out once, `recurrent` changes each tick.
    """

    recalled: NDArray[np.float32]
    recurrent: NDArray[np.float32]


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
    """Encoder, attractor and generator of one model, one thread each, checked before use.

    The generator is two graphs: `recall` runs once a behavior, `generator` each tick.
    """

    def __init__(
        self,
        sessions: dict[str, ort.InferenceSession],
        metadata: Metadata,
        shape: PathShape | None = None,
    ) -> None:
        graphs = [Graph(sessions[name], name) for name in GRAPHS]
        self._encoder, self._attractor, self._recall, self._generator = graphs
        self._metadata = metadata
        self._shape = shape
        self._encoder_zeros = self._encoder.zeros("state")
        self._generator_zeros = self._generator.zeros("state")

    @classmethod
    def load(cls, folder: Path = PACKAGED_MODELS) -> Networks:
        """Open the file of each of `GRAPHS` in `folder`, and `shape.onnx` where there is one.

        All is checked before anything is built.

        Raises:
            ModelError: a file is missing, too large or no ONNX; names, shapes or types differ
                from `cbe.signature`; metadata is missing; or they are of different models.
        """
        files = {name: ModelFile.read(folder / f"{name}.onnx") for name in GRAPHS}
        generator = files["generator"]
        recalled = open_size(generator, "recalled")
        check_graph(files["encoder"], signature.encoder(open_size(files["encoder"], "state")))
        check_graph(files["attractor"], signature.attractor())
        check_graph(files["recall"], signature.recall(recalled))
        check_graph(generator, signature.generator(open_size(generator, "state"), recalled))
        metadata, *others = [read_metadata(file) for file in files.values()]
        if any(other != metadata for other in others):
            ids = ", ".join(each.model_id for each in (metadata, *others))
            raise ModelError(
                f"the networks in {folder} are of different models ({ids}); export all from one "
                "checkpoint"
            )
        shape = PathShape.load(folder) if PathShape.there(folder) else None
        if shape is not None and shape.model_id != metadata.model_id:
            raise ModelError(
                f"in {folder} shape.onnx is of model {shape.model_id}, the others are of "
                f"{metadata.model_id}; export all from one checkpoint, or delete shape.onnx"
            )
        return cls({name: open_session(file) for name, file in files.items()}, metadata, shape)

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

    def encoder_state(self) -> NDArray[np.float32]:
        """The state (size,) before a behavior's first frame."""
        return self._encoder_zeros

    def encode(
        self, image: NDArray[np.uint8], state: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """See one frame.

        Args:
            image: (64, 64, 3) uint8 RGB, the model's view.
            state: (size,) of the previous network frame, or `encoder_state()` on a behavior's
                first.

        Returns:
            features (*FEATURES), embedding z (32,) of the frames since the first, next state.

        Raises:
            ModelError: an output is not finite.
        """
        features, embedding, state = self._encoder.run(image, state)
        return features, embedding, state

    def attract(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Attractor (400,) of the frame whose features (*FEATURES) these are.

        Raises:
            ModelError: an output is not finite.
        """
        attractor: NDArray[np.float32]
        (attractor,) = self._attractor.run(features)
        return attractor

    def path_m(self, embedding: NDArray[np.float32]) -> NDArray[np.float64] | None:
        """Points (8, 2) as `PathShape.read`, or None if the model does not tell.

        Raises:
            ModelError: an output is not finite.
        """
        return None if self._shape is None else self._shape.read(embedding)

    def recall(
        self,
        *,
        attractor_first: NDArray[np.float32],
        attractor_start: NDArray[np.float32],
        attractor_goal: NDArray[np.float32],
        embedding_goal: NDArray[np.float32],
    ) -> GeneratorState:
        """The state before the first tick of the behavior from `attractor_start` to `_goal`.

        Attractors (400,) float32 are those of the repetition's first frame of this behavior and of
        the demonstration's two; the embedding is (32,).

        Raises:
            ModelError: an output is not finite.
        """
        (recalled,) = self._recall.run(
            attractor_first, attractor_start, attractor_goal, embedding_goal
        )
        return GeneratorState(recalled, self._generator_zeros)

    def generate(
        self,
        attractor: NDArray[np.float32],
        embedding: NDArray[np.float32],
        state: GeneratorState,
    ) -> tuple[Prediction, GeneratorState]:
        """Where to go next, from this frame's attractor (400,) and embedding (32,).

        Raises:
            ModelError: an output is not finite.
        """
        waypoint_m, progress, on_route, end, recurrent = self._generator.run(
            state.recalled, attractor, embedding, state.recurrent
        )
        prediction = Prediction(
            waypoint_m.astype(np.float64),
            progress.item(),
            on_route.item(),
            end.astype(np.float64),
        )
        return prediction, GeneratorState(state.recalled, recurrent)
