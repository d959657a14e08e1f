"""Names, shapes and types of the ONNX graphs and of their metadata.

Four drive; `shape` tells how a route goes on past a joint, and may be missing.

The one place that names them: the exporter writes to it and the runtime refuses what differs.
Batch 1, one tick, every recurrent state explicit (paper, Sec. III-B to III-D).
"""

from dataclasses import dataclass

CONTRACT_VERSION = 3
"""Of the tensors below and what they mean; a folder of another version is refused."""
PREPROCESSING_VERSION = 2
"""Of how a view becomes numbers; part of the model id, by which a route knows its model."""

IMAGE_SIZE = 64
FEATURES = (32, 16, 16)
ATTRACTOR_SHAPE = (8, 5, 10)  # channels, rows, columns; turning the robot shifts the columns
ATTRACTOR_SIZE = 400
EMBEDDING_SIZE = 32
LOOKAHEAD_M = 0.6  # a waypoint lies so far ahead along the demonstration
OVERRUN_M = 0.3  # a waypoint runs on so far, straight, past a behavior's end
SHAPE_POINTS = 8


@dataclass(frozen=True, slots=True)
class Tensor:
    """One input or output: its name, shape and onnxruntime element type."""

    name: str
    shape: tuple[int, ...]
    dtype: str = "tensor(float)"


@dataclass(frozen=True, slots=True)
class Graph:
    """One ONNX file: `<name>.onnx` with these tensors, in this order."""

    name: str
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]


def encoder(state_size: int) -> Graph:
    """Behavior encoder of one image (1, 64, 64, 3) uint8 RGB.

    `state` is all zeros at a behavior's first frame; `embedding` is z of the frames seen since
    then (32 numbers).
    """
    state = (1, state_size)
    return Graph(
        "encoder",
        (Tensor("image", (1, IMAGE_SIZE, IMAGE_SIZE, 3), "tensor(uint8)"), Tensor("state", state)),
        (
            Tensor("features", (1, *FEATURES)),
            Tensor("embedding", (1, EMBEDDING_SIZE)),
            Tensor("state_next", state),
        ),
    )


def attractor() -> Graph:
    """Attractor: from the encoder's features to 400 numbers in [0, 1]."""
    return Graph(
        "attractor",
        (Tensor("features", (1, *FEATURES)),),
        (Tensor("attractor", (1, ATTRACTOR_SIZE)),),
    )


def recall(recalled_size: int) -> Graph:
    """What of the generator's work stays the same while a behavior lasts, done at its first frame.

    `attractor_first` is that frame's; the others are what is remembered of the demonstration.
    """
    attractors = ("attractor_first", "attractor_start", "attractor_goal")
    return Graph(
        "recall",
        (
            *(Tensor(name, (1, ATTRACTOR_SIZE)) for name in attractors),
            Tensor("embedding_goal", (1, EMBEDDING_SIZE)),
        ),
        (Tensor("recalled", (1, recalled_size)),),
    )


def generator(state_size: int, recalled_size: int) -> Graph:
    """Waypoint generator: `waypoint_m` is x, y in base_link; progress runs 0 to 1.

    `on_route` is the probability of being within 1 m of the demonstration. `end` is x, y, cos, sin
    of the behavior's last pose in base_link, as far as `attractor_now` shows it.
    """
    state = (1, state_size)
    return Graph(
        "generator",
        (
            Tensor("recalled", (1, recalled_size)),
            Tensor("attractor_now", (1, ATTRACTOR_SIZE)),
            Tensor("embedding_now", (1, EMBEDDING_SIZE)),
            Tensor("state", state),
        ),
        (
            Tensor("waypoint_m", (1, 2)),
            Tensor("progress", (1, 1)),
            Tensor("on_route", (1, 1)),
            Tensor("end", (1, 4)),
            Tensor("state_next", state),
        ),
    )


def shape() -> Graph:
    """Path read off an embedding: points x, y in m at equal shares of a behavior's time.

    In the frame of its first pose, the last point being its end. Auxiliary: a model folder
    without it still drives.
    """
    return Graph(
        "shape",
        (Tensor("embedding", (1, EMBEDDING_SIZE)),),
        (Tensor("path_m", (1, SHAPE_POINTS, 2)),),
    )


METADATA_KEYS = (
    "cbe.contract_version",  # str(CONTRACT_VERSION)
    "cbe.model_id",  # 16 hex digits: hash of weights + preprocessing + quantisation
    "cbe.network_period",  # steps between two network ticks, "1" or "2"
    "cbe.camera",  # JSON of cbe.camera.CameraModel
    "cbe.segment_steps",  # K: longest behavior in steps
    "cbe.precision",  # "fp32" or "int8"
)
