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

    To hand arrays over anew each tick took a twelfth of it. Arrays come and go without the batch's
    axis, which is 1.
    """

    def __init__(self, session: ort.InferenceSession, name: str) -> None:
        """Bind a session whose shapes are all known."""
        self._session, self._name = session, name
        self._binding = session.io_binding()
        self._inputs: dict[str, NDArray[Any]] = {}
        for node in session.get_inputs():
            array = self._inputs[node.name] = np.zeros(node.shape[1:], _TYPES[node.type])
            place = array.ctypes.data
            self._binding.bind_input(node.name, "cpu", 0, array.dtype, node.shape, place)
        # All outputs lie in one row, which is checked and copied at once.
        sizes = [math.prod(node.shape) for node in session.get_outputs()]
        self._row = np.zeros(sum(sizes), np.float32)
        self._outputs = []
        first = 0
        for node, size in zip(session.get_outputs(), sizes, strict=True):
            self._outputs.append((slice(first, first + size), tuple(node.shape[1:])))
            place = self._row[first:].ctypes.data
            self._binding.bind_output(node.name, "cpu", 0, np.float32, node.shape, place)
            first += size

    def zeros(self, name: str) -> NDArray[Any]:
        """An input of that name, all zero."""
        return np.zeros_like(self._inputs[name])

    def run(self, *values: NDArray[Any]) -> list[NDArray[np.float32]]:
        """All outputs for all inputs, in the graph's order, in arrays that are the caller's.

        Raises:
            ModelError: an input's shape is wrong, the session failed, or an output is not finite.
        """
        for (name, array), value in zip(self._inputs.items(), values, strict=True):
            if value.shape != array.shape:
                raise ModelError(
                    f"the {self._name} network takes {name} {array.shape}; found {value.shape}"
                )
            array[...] = value
        try:
            self._session.run_with_iobinding(self._binding)
        except ORT_FAULTS as fault:
            raise ModelError(f"the {self._name} network failed: {fault}") from fault
        row = self._row.copy()
        # Any inf or NaN makes the sum of squares non-finite: one pass, no temporary mask.
        if not math.isfinite(row.dot(row)):
            raise ModelError(
                f"the {self._name} network put out a value that is not finite; stop and check it"
            )
        return [row[part].reshape(shape) for part, shape in self._outputs]
