"""Route memory: attractors at the joints, one embedding a segment (paper, Sec. III-D)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import RouteError
from cbe.signature import ATTRACTOR_SIZE, EMBEDDING_SIZE
from cbe_runtime.likeness import ALIKE, unlikeness

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from cbe.camera import CameraModel
    from cbe_runtime.networks import Networks


class AttractorPrecision(StrEnum):
    """How the numbers of an attractor, all in [0, 1], are stored; the scale is fixed."""

    F32 = "f32"
    U8 = "u8"
    U4 = "u4"

    @property
    def size_bytes(self) -> int:
        """Bytes of one stored attractor."""
        bits = {AttractorPrecision.F32: 32, AttractorPrecision.U8: 8, AttractorPrecision.U4: 4}
        return ATTRACTOR_SIZE * bits[self] // 8

    def pack(self, attractor: NDArray[np.float32]) -> bytes:
        """Store an attractor (400,) float32; what lies outside [0, 1] is clipped."""
        if self is AttractorPrecision.F32:
            return attractor.astype("<f4").tobytes()
        levels = 255 if self is AttractorPrecision.U8 else 15
        codes = np.rint(levels * np.clip(attractor, 0.0, 1.0)).astype(np.uint8)
        if self is AttractorPrecision.U4:
            return bytes((codes[0::2] << 4) | codes[1::2])  # (200,), two numbers a byte
        return codes.tobytes()

    def unpack(self, stored: bytes) -> NDArray[np.float32]:
        """The attractor (400,) float32 behind `size_bytes` bytes."""
        if self is AttractorPrecision.F32:
            return np.frombuffer(stored, "<f4").astype(np.float32)
        codes = np.frombuffer(stored, np.uint8)
        if self is AttractorPrecision.U8:
            return codes.astype(np.float32) / np.float32(255)
        pairs = np.stack([codes >> 4, codes & 15], axis=1)  # (200, 2)
        return pairs.reshape(-1).astype(np.float32) / np.float32(15)  # (400,)


class EmbeddingPrecision(StrEnum):
    """How the numbers of an embedding are stored; i8 carries a float32 scale of its own."""

    F32 = "f32"
    F16 = "f16"
    I8 = "i8"

    @property
    def size_bytes(self) -> int:
        """Bytes of one stored embedding."""
        return {
            EmbeddingPrecision.F32: 4 * EMBEDDING_SIZE,
            EmbeddingPrecision.F16: 2 * EMBEDDING_SIZE,
            EmbeddingPrecision.I8: 4 + EMBEDDING_SIZE,
        }[self]

    def pack(self, embedding: NDArray[np.float32]) -> bytes:
        """Store an embedding (32,) float32."""
        if self is EmbeddingPrecision.F32:
            return embedding.astype("<f4").tobytes()
        if self is EmbeddingPrecision.F16:
            largest = np.finfo(np.float16).max
            clipped: NDArray[np.float32] = np.clip(embedding, -largest, largest)
            return clipped.astype("<f2").tobytes()
        scale = np.maximum(np.abs(embedding).max(keepdims=True) / 127, np.finfo(np.float32).tiny)
        codes = np.rint(embedding / scale).astype(np.int8)
        return b"".join([scale.astype("<f4").tobytes(), codes.tobytes()])

    def unpack(self, stored: bytes) -> NDArray[np.float32]:
        """The embedding (32,) float32 behind `size_bytes` bytes."""
        if self is not EmbeddingPrecision.I8:
            name = "<f4" if self is EmbeddingPrecision.F32 else "<f2"
            return np.frombuffer(stored, name).astype(np.float32)
        scale = np.frombuffer(stored, "<f4", count=1)
        values: NDArray[np.float32] = np.frombuffer(stored, np.int8, offset=4) * scale
        return values.astype(np.float32)


@dataclass(frozen=True, slots=True)
class Precision:
    """How one route stores its attractors and its embeddings."""

    attractor: AttractorPrecision = AttractorPrecision.U8
    embedding: EmbeddingPrecision = EmbeddingPrecision.F16


@dataclass(frozen=True, slots=True)
class Segment:
    """One behavior: its stored embedding and its demonstration's length in steps."""

    embedding: bytes
    steps: int


@dataclass(frozen=True, slots=True)
class Route:
    """A taught drive.

    `attractors` holds one stored attractor more than there are segments: segment i runs from
    attractor i to attractor i + 1, so neighbours share the joint's. Values stay stored and are
    decoded when the follower enters a segment. `camera` is the one that saw the drive.
    """

    model_id: str
    camera: CameraModel
    network_period: int
    precision: Precision
    attractors: tuple[bytes, ...]
    segments: tuple[Segment, ...]
    tags: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the parts fit together.

        Raises:
            RouteError: counts or sizes disagree, or a stored value is not finite.
        """
        if not self.segments or len(self.attractors) != len(self.segments) + 1:
            raise RouteError(
                f"the route has {len(self.segments)} segments and {len(self.attractors)} "
                "attractors, expected at least one segment and one attractor more; teach it again"
            )
        _check_sizes("attractor", self.attractors, self.precision.attractor.size_bytes)
        embeddings = [segment.embedding for segment in self.segments]
        _check_sizes("embedding", embeddings, self.precision.embedding.size_bytes)
        if any(segment.steps < 1 for segment in self.segments):
            raise RouteError("a segment of the route has no steps; teach it again")
        if self.precision.attractor is AttractorPrecision.F32:
            _check_finite("attractor", np.frombuffer(b"".join(self.attractors), "<f4"))
        _check_finite("embedding", np.stack([self.embedding(i) for i in range(len(embeddings))]))

    @property
    def steps(self) -> int:
        """Length of the whole drive in steps."""
        return sum(segment.steps for segment in self.segments)

    def attractor(self, joint: int) -> NDArray[np.float32]:
        """Attractor (400,) at a joint: the start of segment `joint`, the end of the one before."""
        return self.precision.attractor.unpack(self.attractors[joint])

    def embedding(self, segment: int) -> NDArray[np.float32]:
        """Embedding z (32,) of a segment's demonstration."""
        return self.precision.embedding.unpack(self.segments[segment].embedding)

    def join(self, other: Route) -> Route:
        """This route and then the other, which must begin where this one ends.

        The joint keeps the other's first attractor, so that the last segment leads to where the
        other was taught from. Tags are merged; where both have one, this route's stays.

        Raises:
            RouteError: model, camera, precision or network period differ, or the places do.
        """
        for name in ("model_id", "network_period", "camera", "precision"):
            mine, its = getattr(self, name), getattr(other, name)
            if mine != its:
                raise RouteError(
                    f"the routes cannot be joined: their {name} differs ({mine} and {its}); teach "
                    "both alike"
                )
        apart = float(unlikeness(self.attractor(len(self.segments)), other.attractor(0)))
        if apart > ALIKE:
            raise RouteError(
                "the end of the first route does not look like the start of the second: they "
                f"differ by {apart:.2f}, expected at most {ALIKE:.2f}; teach the second from where "
                "the first ends, within 0.3 m and 15 deg"
            )
        return replace(
            self,
            attractors=self.attractors[:-1] + other.attractors,
            segments=self.segments + other.segments,
            tags={**other.tags, **self.tags},
        )

    def require_model(self, networks: Networks) -> None:
        """Refuse to be repeated by networks other than those that taught it.

        Raises:
            RouteError: the model differs.
        """
        if self.model_id != networks.model_id or self.network_period != networks.network_period:
            raise RouteError(
                f"the route was taught with model {self.model_id} (network period "
                f"{self.network_period}), but the model in use is {networks.model_id} (network "
                f"period {networks.network_period}); re-teach it with cbe-teach or give the "
                "model's folder with --model"
            )


def _check_sizes(what: str, stored: Sequence[bytes], size: int) -> None:
    for index, each in enumerate(stored):
        if len(each) != size:
            raise RouteError(
                f"{what} {index} of the route has {len(each)} bytes, expected {size}; "
                "teach it again"
            )


def _check_finite(what: str, values: NDArray[np.float32]) -> None:
    if not np.isfinite(values).all():
        raise RouteError(f"an {what} of the route is not finite; teach it again")
