"""`cbe-route`: looks into a route file."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from cbe_runtime import routefile

DESCRIPTION = "Look into a route file."


def add_options(parser: argparse.ArgumentParser) -> None:
    """Subcommand info."""
    commands = parser.add_subparsers(dest="command", required=True)
    info = commands.add_parser("info", help="size by part, length, segments, model, camera")
    info.add_argument("route", type=Path)
    info.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Print what a route holds.

    Raises:
        RouteError: the file is refused.
    """
    route = routefile.load(options.route)
    attractor_bytes = sum(map(len, route.attractors))
    embedding_bytes = sum(len(segment.embedding) for segment in route.segments)
    file_bytes = options.route.stat().st_size
    lengths = [segment.steps for segment in route.segments]
    facts: dict[str, object] = {
        "file_bytes": file_bytes,
        "attractor_bytes": attractor_bytes,
        "embedding_bytes": embedding_bytes,
        "other_bytes": file_bytes - attractor_bytes - embedding_bytes,
        "attractors": len(route.attractors),
        "segments": len(route.segments),
        "steps": route.steps,
        "segment_steps": lengths,
        "attractor_precision": route.precision.attractor.value,
        "embedding_precision": route.precision.embedding.value,
        "network_period": route.network_period,
        "model_id": route.model_id,
        "camera": route.camera.to_dict(),
        "tags": dict(route.tags),
    }
    if options.json:
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        sys.stdout.writelines(f"{name:20} {value}\n" for name, value in facts.items())
    return 0
