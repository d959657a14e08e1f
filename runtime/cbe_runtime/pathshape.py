"""The path that a route leads along, as far as its embeddings tell (paper, Sec. IV-B)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cbe import signature
from cbe.errors import ModelError, RouteError
from cbe.geometry import from_frame
from cbe_runtime.modelfile import (
    ORT_FAULTS,
    ModelFile,
    check_graph,
    open_session,
    read_metadata,
)

if TYPE_CHECKING:
    from pathlib import Path

    import onnxruntime as ort
    from numpy.typing import NDArray

    from cbe_runtime.route import Route

SHAPE_FILE = f"{signature.shape().name}.onnx"


class PathShape:
    """Reads the shape of a behavior's path off its embedding."""

    def __init__(self, session: ort.InferenceSession, model_id: str) -> None:
        self._session = session
        self.model_id = model_id

    @staticmethod
    def there(folder: Path) -> bool:
        """Whether a model's folder has a `shape.onnx`."""
        return (folder / SHAPE_FILE).is_file()

    @classmethod
    def load(cls, folder: Path) -> PathShape:
        """Open `shape.onnx` of a model's folder.

        Raises:
            ModelError: the folder has none, or it does not match `cbe.signature`.
        """
        graph = signature.shape()
        path = folder / SHAPE_FILE
        if not cls.there(folder):
            raise ModelError(
                f"the model in {folder} has no {path.name}, which reads a path off an embedding; "
                "export it again with this version of cbe-export, or give a folder that has it "
                "with --model"
            )
        file = ModelFile.read(path)
        check_graph(file, graph)
        metadata = read_metadata(file)
        return cls(open_session(file), metadata.model_id)

    def read(self, embedding: NDArray[np.float32]) -> NDArray[np.float64]:
        """Points (8, 2) in m along the path of embedding z (32,), in the frame of its start.

        Raises:
            ModelError: the network fails, or a point is not finite.
        """
        try:
            (path_m,) = self._session.run(None, {"embedding": embedding[None]})
        except ORT_FAULTS as fault:
            raise ModelError(f"the shape network failed: {fault}") from fault
        points: NDArray[np.float64] = path_m[0].astype(np.float64)
        if not np.isfinite(points).all():
            raise ModelError("the shape network put out a point that is not finite; check it")
        return points

    def lay(self, route: Route) -> list[NDArray[np.float64]]:
        """Each segment's path (9, 2) in m, laid end to end in the frame of the route's start.

        A segment begins where the one before ends, turned as its last two points are. Errors add
        up: over eight drives of 9 m on average the end was off by 15 % of the way in the median,
        34 % at worst.

        Raises:
            RouteError: the route was taught with another model.
            ModelError: the network fails.
        """
        if route.model_id != self.model_id:
            raise RouteError(
                f"the route was taught with model {route.model_id}, but shape.onnx is of "
                f"{self.model_id}; give the folder of the route's model with --model"
            )
        pose = np.zeros(3)
        paths = []
        for segment in range(len(route.segments)):
            own = np.concatenate([np.zeros((1, 2)), self.read(route.embedding(segment))])
            path = from_frame(pose, own)  # (9, 2)
            paths.append(path)
            ahead = path[-1] - path[-2]
            pose = np.array([*path[-1], math.atan2(ahead[1], ahead[0])])
        return paths
