"""How to cut and store a drive so that its route takes no more bytes a metre than allowed."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import ConfigError, RouteError
from cbe.robot import STEP_S, Robot
from cbe_runtime import routefile
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision, Segment

if TYPE_CHECKING:
    from cbe_runtime.pathshape import PathShape
    from cbe_runtime.route import Route

FINEST_FIRST = (
    Precision(AttractorPrecision.U8, EmbeddingPrecision.F16),
    Precision(AttractorPrecision.U4, EmbeddingPrecision.F16),
    Precision(AttractorPrecision.U4, EmbeddingPrecision.I8),
)
"""float32 is left out: it takes four times the bytes of uint8 and repeats no better."""
SHORTEST = 0.5  # of the longest segment: what is left of a budget shortens segments down to this


@dataclass(frozen=True, slots=True)
class Plan:
    """A way to teach a drive, and the bytes that its route will take."""

    segment_steps: int
    precision: Precision
    size_bytes: int


def parse(text: str) -> float:
    """Bytes a metre of a text such as `100B/m`; ConfigError where it is none."""
    found = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)\s?B/m", text)
    if found is None or float(found[1]) == 0.0:
        raise ConfigError(f"a budget is bytes a metre, as in 100B/m; found {text[:40]!r}")
    return float(found[1])


def length_m(route: Route, shape: PathShape | None) -> tuple[float, str]:
    """How long the drive was, and what says so: its embeddings, or only its duration."""
    if shape is None:
        speed_mps = Robot().max_speed_mps
        return route.steps * STEP_S * speed_mps, f"at {speed_mps:g} m/s all the time"
    paths = shape.lay(route)
    return float(sum(np.hypot(*np.diff(path, axis=0).T).sum() for path in paths)), "by embeddings"


def plan(route: Route, drive_m: float, bytes_per_m: float, longest_steps: int) -> Plan:
    """The finest precision that fits in segments of `longest_steps` at most, then the shortest.

    Args:
        route: the drive's, however it was cut and stored.
        drive_m: its length.
        bytes_per_m: the budget.
        longest_steps: that the model repeats well.

    Raises:
        RouteError: not even the coarsest precision fits.
    """
    fewest = math.ceil(route.steps / longest_steps)
    most = max(math.floor(route.steps / (SHORTEST * longest_steps)), fewest)
    for precision in FINEST_FIRST:
        for segments in range(most, fewest - 1, -1):
            size_bytes = _size_bytes(route, segments, precision)
            if size_bytes <= bytes_per_m * drive_m:
                return Plan(math.ceil(route.steps / segments), precision, size_bytes)
    least = _size_bytes(route, fewest, FINEST_FIRST[-1])
    raise RouteError(
        f"{bytes_per_m:g} B/m are {bytes_per_m * drive_m:.0f} bytes for this drive of "
        f"{drive_m:.1f} m, but {fewest} segments of {longest_steps} steps at most take {least} "
        f"bytes at the coarsest ({least / drive_m:.0f} B/m); allow more, or give a model of longer "
        "segments with --model"
    )


def _size_bytes(route: Route, segments: int, precision: Precision) -> int:
    """Of the route's file, were it cut into so many segments and stored so."""
    steps = math.ceil(route.steps / segments)
    sample = replace(
        route,
        precision=precision,
        attractors=(bytes(precision.attractor.size_bytes),) * (segments + 1),
        segments=(Segment(bytes(precision.embedding.size_bytes), steps),) * segments,
    )
    return len(routefile.dump(sample))
