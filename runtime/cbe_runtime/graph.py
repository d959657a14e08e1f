"""One ONNX graph that is run again and again, on buffers bound once."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from cbe.errors import ModelError
from cbe_runtime.modelfile import ORT_FAULTS

if TYPE_CHECKING:
    import onnxruntime as ort
    from numpy.typing import NDArray

_TYPES = {"tensor(float)": np.float32, "tensor(uint8)": np.uint8}


class Graph:
    """A session with its inputs and outputs in memory of its own; for one thread at a time.

    To hand arrays over anew each tick took a twelfth of it.
    """

    def __init__(self, session: ort.InferenceSession, name: str) -> None:
        """Bind a session whose shapes are all known."""
        self._session, self._name = session, name
        self._binding = session.io_binding()
        self._inputs: dict[str, NDArray[Any]] = {
            node.name: np.zeros(node.shape, _TYPES[node.type]) for node in session.get_inputs()
        }
        for key, array in self._inputs.items():
            self._binding.bind_input(key, "cpu", 0, array.dtype, array.shape, array.ctypes.data)
        # All outputs lie in one row, which is checked and copied at once.
        shapes = [tuple(node.shape) for node in session.get_outputs()]
        ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
        self._row = np.zeros(ends[-1], np.float32)
        self._parts = list(zip([0, *ends], ends, shapes, strict=False))
        for node, (first, end, shape) in zip(session.get_outputs(), self._parts, strict=True):
            place = self._row[first:end].ctypes.data
            self._binding.bind_output(node.name, "cpu", 0, np.float32, shape, place)

    def zeros(self, name: str) -> NDArray[Any]:
        """An input of that name, all zero."""
        return np.zeros_like(self._inputs[name])

    def run(self, inputs: dict[str, NDArray[Any]]) -> list[NDArray[np.float32]]:
        """All outputs for all inputs, in arrays that are the caller's.

        Raises:
            ModelError: an input's shape is wrong, the session failed, or an output is not finite.
        """
        for name, value in inputs.items():
            array = self._inputs[name]
            if value.shape != array.shape:
                raise ModelError(
                    f"the {self._name} network takes {name} {array.shape}; found {value.shape}"
                )
            np.copyto(array, value)
        try:
            self._session.run_with_iobinding(self._binding)
        except ORT_FAULTS as fault:
            raise ModelError(f"the {self._name} network failed: {fault}") from fault
        row = self._row.copy()
        # Any inf or NaN makes the sum of squares non-finite: one pass, no temporary mask.
        if not math.isfinite(np.vdot(row, row)):
            raise ModelError(
                f"the {self._name} network put out a value that is not finite; stop and check it"
            )
        return [row[first:end].reshape(shape) for first, end, shape in self._parts]
