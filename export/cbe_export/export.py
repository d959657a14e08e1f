"""Write the ONNX graphs: exported, checked, stamped with metadata and gated by parity."""

import hashlib
import json
import logging
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import onnx
import torch

from cbe import signature
from cbe.camera import MODEL_CAMERA
from cbe.errors import ModelError
from cbe_export.graphs import ticks
from cbe_export.parity import Rides, worst_difference
from cbe_export.quantise import quantise
from cbe_export.storing import save
from cbe_training.checkpoint import load_networks
from cbe_training.networks import BehaviorNetworks

TOLERANCE = 1e-4
LEAST_TICKS = 200
OPSET = 18

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written: the model's id, the parity measured and the files' sizes in bytes."""

    model_id: str
    worst_difference: float
    ticks: int
    sizes: dict[str, int]


def export(
    checkpoint: Path,
    folder: Path,
    *,
    network_period: int,
    segment_steps: int,
    cache: Path,
    precision: str = "fp32",
) -> Exported:
    """Export the checkpoint's averaged networks to `folder`, in `fp32` or quantised to `int8`.

    Raises ModelError, writing nothing, if onnxruntime differs from torch by more than 1e-4
    anywhere in at least 200 ticks of real rollouts.
    """
    networks = load_networks(checkpoint).half().float()  # stored in half precision
    rides = Rides.record(networks, cache)
    with tempfile.TemporaryDirectory() as scratch:
        staging = Path(scratch)
        model_id = write_graphs(
            networks,
            staging,
            network_period=network_period,
            segment_steps=segment_steps,
            precision=precision,
        )
        worst, count = worst_difference(networks, staging, rides)
        if not worst <= TOLERANCE or count < LEAST_TICKS:
            raise ModelError(
                f"onnxruntime differs from torch by {worst:.2g} over {count} ticks; expected at "
                f"most {TOLERANCE} over at least {LEAST_TICKS}; nothing was written"
            )
        if precision == "int8":
            quantise(networks, staging, rides)
        folder.mkdir(parents=True, exist_ok=True)
        sizes = {}
        for path in sorted(staging.glob("*.onnx")):
            data = path.read_bytes()
            part = folder / f"{path.name}.part"
            part.write_bytes(data)
            part.replace(folder / path.name)
            sizes[path.name] = len(data)
    logger.info("model %s: parity %.2g over %d ticks", model_id, worst, count)
    return Exported(model_id, worst, count, sizes)


def identify(networks: BehaviorNetworks, precision: str = "fp32") -> str:
    """16 hex digits that change with the weights, the preprocessing or the quantisation."""
    digest = hashlib.sha256(f"{signature.PREPROCESSING_VERSION} {_camera()} {precision}".encode())
    for name, value in sorted(networks.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def _camera() -> str:
    return json.dumps(MODEL_CAMERA.to_dict(), sort_keys=True)


def write_graphs(
    networks: BehaviorNetworks,
    folder: Path,
    *,
    network_period: int,
    segment_steps: int,
    precision: str = "fp32",
) -> str:
    """Write a file for each graph of `cbe.signature`; returns the model id.

    `precision` is what the model is named after; the graphs are not yet quantised.
    """
    model_id = identify(networks, precision)
    values = (
        str(signature.CONTRACT_VERSION),
        model_id,
        str(network_period),
        _camera(),
        str(segment_steps),
        precision,
    )
    metadata = dict(zip(signature.METADATA_KEYS, values, strict=True))
    for graph, module in ticks(networks):
        path = folder / f"{graph.name}.onnx"
        inputs = tuple(
            torch.zeros(t.shape, dtype=torch.uint8 if "uint8" in t.dtype else torch.float32)
            for t in graph.inputs
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the exporter's own deprecations
            torch.onnx.export(
                module.eval(),
                inputs,
                str(path),
                input_names=[t.name for t in graph.inputs],
                output_names=[t.name for t in graph.outputs],
                opset_version=OPSET,
                dynamo=True,
                external_data=False,
                verbose=False,
            )
        save(onnx.load(path), path, metadata)
    return model_id
