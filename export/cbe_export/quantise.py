"""Static 8-bit quantisation (QDQ) of exported graphs, calibrated on rollouts."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from cbe_export.parity import GRAPHS, Arrays, Rides, replay
from cbe_export.storing import restore_from_half, save
from cbe_training.networks import BehaviorNetworks

QUANTISED = ("encoder", "attractor", "generator")
OPERATORS = ("Conv", "Gemm", "MatMul")
"""What weighs; the path that is added up and laid out is left exact."""


class _Recorder:
    """A session that keeps the inputs it is run with."""

    def __init__(self, path: Path) -> None:
        self._session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        self.inputs: list[Arrays] = []

    def get_outputs(self) -> Any:
        return self._session.get_outputs()

    def run(self, names: list[str], inputs: Arrays) -> Any:
        names_in = [node.name for node in self._session.get_inputs()]
        self.inputs.append({name: inputs[name].copy() for name in names_in})
        return self._session.run(names, self.inputs[-1])


class _Reader(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, inputs: list[Arrays]) -> None:
        self._left: Iterator[Arrays] = iter(inputs)

    def get_next(self) -> Arrays | None:
        """The next tick's inputs, until there are no more."""
        return next(self._left, None)


def quantise(networks: BehaviorNetworks, folder: Path, rides: Rides) -> None:
    """Replace the graphs in `folder` by ones whose weights and activations have 8 bits.

    Weights get a scale for each output channel, activations the range that they have in `rides`.
    """
    sessions = {name: _Recorder(folder / f"{name}.onnx") for name in GRAPHS}
    for images, frames, shown in zip(rides.images, rides.frames, rides.shown, strict=True):
        replay(networks, sessions, images[:frames], shown)
    for name in QUANTISED:
        path = folder / f"{name}.onnx"
        model = onnx.load(path)
        metadata = {prop.key: prop.value for prop in model.metadata_props}
        restore_from_half(model)
        quantize_static(
            model,
            path,
            _Reader(sessions[name].inputs),
            QuantFormat.QDQ,
            op_types_to_quantize=list(OPERATORS),
            per_channel=True,
            reduce_range=True,  # or sums overflow on processors without VNNI
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        save(onnx.load(path), path, metadata)
