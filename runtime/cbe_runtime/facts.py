"""What a route holds, and how two routes differ."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cbe_runtime.likeness import ALIKE, unlikeness

if TYPE_CHECKING:
    from cbe_runtime.route import Route


def facts(route: Route, file_bytes: int) -> dict[str, Any]:
    """Sizes, lengths and makers of a route whose file has so many bytes; JSON can hold it."""
    attractor_bytes = sum(map(len, route.attractors))
    embedding_bytes = sum(len(segment.embedding) for segment in route.segments)
    return {
        "file_bytes": file_bytes,
        "attractor_bytes": attractor_bytes,
        "embedding_bytes": embedding_bytes,
        "other_bytes": file_bytes - attractor_bytes - embedding_bytes,
        "attractors": len(route.attractors),
        "segments": len(route.segments),
        "steps": route.steps,
        "segment_steps": [segment.steps for segment in route.segments],
        "attractor_precision": route.precision.attractor.value,
        "embedding_precision": route.precision.embedding.value,
        "network_period": route.network_period,
        "model_id": route.model_id,
        "camera": route.camera.to_dict(),
        "tags": dict(route.tags),
    }


def differences(a: Route, b: Route, a_bytes: int, b_bytes: int) -> dict[str, Any]:
    """Where two routes differ; JSON can hold it.

    `facts` maps each fact that differs to both values; `same_first` and `same_last` count the
    segments that both begin and end with, attractors included; `unlikeness` compares the ends'
    attractors (below `likeness.ALIKE` they are of one place), None where the models differ.
    """
    of_a, of_b = facts(a, a_bytes), facts(b, b_bytes)
    same_first = _same_first(_parts(a), _parts(b))
    same_last = _same_first(_parts(a)[::-1], _parts(b)[::-1])
    return {
        "same": a == b,
        "facts": {name: [of_a[name], of_b[name]] for name in of_a if of_a[name] != of_b[name]},
        "same_first": same_first,
        "same_last": same_last,
        "unlikeness": _ends(a, b) if a.model_id == b.model_id else None,
        "alike_below": ALIKE,
    }


def _parts(route: Route) -> list[tuple[object, ...]]:
    """Each segment with both its attractors, as stored."""
    joints = zip(route.attractors, route.attractors[1:], route.segments, strict=False)
    return [(route.model_id, route.precision, *part) for part in joints]


def _same_first(a: list[tuple[object, ...]], b: list[tuple[object, ...]]) -> int:
    same = (one == other for one, other in zip(a, b, strict=False))
    return next((count for count, each in enumerate(same) if not each), min(len(a), len(b)))


def _ends(a: Route, b: Route) -> dict[str, float]:
    a_start, a_end = a.attractor(0), a.attractor(len(a.segments))
    b_start, b_end = b.attractor(0), b.attractor(len(b.segments))
    pairs = {
        "starts": (a_start, b_start),
        "ends": (a_end, b_end),
        "end_of_a_and_start_of_b": (a_end, b_start),
        "end_of_b_and_start_of_a": (b_end, a_start),
    }
    return {name: round(float(unlikeness(*pair)), 4) for name, pair in pairs.items()}
