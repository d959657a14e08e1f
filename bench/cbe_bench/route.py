"""Long drives, repeated from a few kilobytes a segment after the other (paper, Sec. IV-C)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA
from cbe.errors import ConfigError
from cbe_bench.evaluation import Evaluation, RunConfig, Stored, evaluate
from cbe_runtime.networks import Networks
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision, Route
from cbe_runtime.teach import Teacher


@dataclass(frozen=True, slots=True)
class Teaching:
    """How drives become routes; `segment_steps` of None takes the model's own K."""

    segment_steps: int | None = None
    precision: Precision = field(default_factory=Precision)
    adaptive: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be taught."""
        if self.segment_steps is not None and self.segment_steps < 1:
            raise ConfigError(f"a segment has at least 1 step, found {self.segment_steps}")

    def __call__(self, networks: Networks, views: Sequence[NDArray[np.uint8]]) -> Route:
        """The route of a drive's views (64, 64, 3), one a step."""
        teacher = Teacher(
            networks,
            MODEL_CAMERA,
            segment_steps=self.segment_steps,
            total_steps=len(views) - 1,
            precision=self.precision,
            adaptive=self.adaptive,
        )
        for view in views:
            teacher.feed(view)
        return teacher.finish()

    def to_dict(self) -> dict[str, Any]:
        """What the result's `config` holds."""
        return {
            "segment_steps": self.segment_steps,
            "precision": self.precision.attractor.value,
            "embedding_precision": self.precision.embedding.value,
            "adaptive": self.adaptive,
        }


@dataclass(frozen=True, slots=True)
class RouteConfig:
    """A run of `cbe-bench route`."""

    run: RunConfig
    teaching: Teaching = field(default_factory=Teaching)


def precision_of(attractors: AttractorPrecision) -> Precision:
    """How a route whose attractors are stored so stores its embeddings too."""
    exact = attractors is AttractorPrecision.F32
    return Precision(attractors, EmbeddingPrecision.F32 if exact else EmbeddingPrecision.F16)


def run(config: RouteConfig, label: str = "routes") -> Evaluation:
    """Drive all episodes; raises CbeError as `evaluate`."""
    teaching = config.teaching
    longest = teaching.segment_steps or Networks.load(config.run.model).segment_steps
    done = evaluate(config.run, teaching, label)
    stored = [trace.stored for trace in done.traces]
    summary = done.summary | memory(stored)
    summary["config"] |= teaching.to_dict() | {"segment_steps": longest}
    summary["runs"] = [
        each | {"route": asdict(route)}
        for each, route in zip(done.summary["runs"], stored, strict=True)
    ]
    return Evaluation(summary, done.traces)


def memory(stored: Sequence[Stored]) -> dict[str, float]:
    """What the drives take in memory, as `--json` holds it.

    `bytes_per_m` is of all drives together. `compression_ratio` is the paper's T / N (Sec. IV-C),
    observations to landmarks, a landmark being a behavior.
    """
    count = len(stored)
    size_bytes = sum(each.size_bytes for each in stored)
    length_m = sum(each.length_m for each in stored)
    return {
        "bytes_mean": size_bytes / count,
        "bytes_per_m": size_bytes / length_m,
        "attractors_mean": sum(each.attractors for each in stored) / count,
        "segments_mean": sum(each.segments for each in stored) / count,
        "steps_mean": sum(each.steps for each in stored) / count,
        "length_mean_m": length_m / count,
        "compression_ratio": sum((each.steps + 1) / each.segments for each in stored) / count,
    }
