"""`cbe-route`: what a route holds, where it leads and how well it may be repeated."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from cbe.errors import RouteError
from cbe_runtime import drawing, facts, footage, forecast, lint, routefile
from cbe_runtime import options as shared
from cbe_runtime.drive import RecordedDrive
from cbe_runtime.networks import Networks
from cbe_runtime.pathshape import PathShape
from cbe_runtime.progressbar import track

DESCRIPTION = "Look into route files, draw, compare and join them, and check them before driving."
EXIT_DIFFERENT = 1
EXIT_FLAGGED = 1


def add_options(parser: argparse.ArgumentParser) -> None:
    """A subcommand each."""
    commands = parser.add_subparsers(dest="command", required=True)

    def add(name: str, does: str, run: Any) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=does, description=f"{does}.", allow_abbrev=False)
        command.set_defaults(run=run)
        return command

    info = add("info", "Size by part, length, segments, model, camera", _info)
    info.add_argument("route", type=Path)
    _add_json(info)

    plot = add("plot", "Draw the path as dead-reckoned from the embeddings", _plot)
    plot.add_argument("route", type=Path)
    plot.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.png")
    shared.add_model(plot)

    diff = add("diff", "Say where two routes differ; exit code 1 if they do", _diff)
    diff.add_argument("a", type=Path)
    diff.add_argument("b", type=Path)
    _add_json(diff)

    join = add("join", "Make one route of A and then B, which begins where A ends", _join)
    join.add_argument("a", type=Path)
    join.add_argument("b", type=Path)
    join.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.msgpack")

    frames = add("frames", "Write a drive's views and odometry for cbe-train --footage", _frames)
    frames.add_argument("drive", type=Path, help="MCAP file with a camera and odometry")
    frames.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.npz")
    frames.add_argument("--topic", help="camera topic of the recording, where it has several")
    shared.add_camera(frames)

    reverse = add("reverse", "Refused, with the reason", _reverse)
    reverse.add_argument("route", type=Path)

    check = add(
        "lint",
        "Replay a drive, as it is and with its images perturbed, against its own route, and "
        "foretell success; exit code 1 if the route is flagged",
        _lint,
    )
    check.add_argument(
        "drive", type=Path, nargs="?", help="MCAP file the route was taught from; without it only "
        "joints and lengths are looked at",
    )  # fmt: skip
    check.add_argument("route", type=Path)
    check.add_argument("--topic", help="camera topic of the recording, where it has several")
    shared.add_camera(check)
    shared.add_model(check)
    _add_json(check)


def run(options: argparse.Namespace) -> int:
    """Do what the subcommand says.

    Raises:
        CbeError: a route, recording or model is refused.
    """
    code: int = options.run(options)
    return code


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def _info(options: argparse.Namespace) -> int:
    route = routefile.load(options.route)
    found = facts.facts(route, options.route.stat().st_size)
    if options.json:
        _print_json(found)
    else:
        sys.stdout.writelines(f"{name:20} {value}\n" for name, value in found.items())
    return 0


def _plot(options: argparse.Namespace) -> int:
    route = routefile.load(options.route)
    paths = PathShape.load(options.model).lay(route)
    name = route.tags.get("name", options.route.name)
    drawing.write_png(drawing.draw(paths, f"{name}, model {route.model_id}"), options.output)
    sys.stdout.write(f"{options.output}: {len(paths)} segments\n")
    return 0


def _diff(options: argparse.Namespace) -> int:
    a, b = routefile.load(options.a), routefile.load(options.b)
    found = facts.differences(a, b, options.a.stat().st_size, options.b.stat().st_size)
    if options.json:
        _print_json(found)
    else:
        sys.stdout.writelines(f"{line}\n" for line in _difference_lines(found))
    return 0 if found["same"] else EXIT_DIFFERENT


def _difference_lines(found: dict[str, Any]) -> list[str]:
    if found["same"]:
        return ["the routes are the same"]
    lines = [f"{name:20} {a} | {b}" for name, (a, b) in found["facts"].items()]
    lines.append(
        f"{'same segments':20} the first {found['same_first']}, the last {found['same_last']}"
    )
    for name, value in (found["unlikeness"] or {}).items():
        verdict = "one place" if value <= found["alike_below"] else "different places"
        lines.append(f"{name.replace('_', ' '):24} {value:.3f}: {verdict}")
    return lines


def _join(options: argparse.Namespace) -> int:
    joined = routefile.load(options.a).join(routefile.load(options.b))
    size = routefile.save(joined, options.output)
    sys.stdout.write(
        f"{options.output}: {size} bytes, {joined.steps} steps in {len(joined.segments)} segments\n"
    )
    return 0


def _frames(options: argparse.Namespace) -> int:
    camera = shared.read_camera(options.camera)
    views, poses = footage.extract(RecordedDrive.open(options.drive, options.topic, camera))
    size = footage.save(options.output, views, poses)
    driven_m = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    sys.stdout.write(f"{options.output}: {size} bytes, {len(views)} frames, {driven_m:.1f} m\n")
    return 0


def _reverse(options: argparse.Namespace) -> int:
    routefile.load(options.route)
    raise RouteError(
        "a route cannot be reversed: its memory is one-way. Attractors are views along the way, "
        "and driving back the camera sees the other half of every room; embeddings are of the "
        "motions in their order. Drive back once and teach that as a route of its own"
    )


def _lint(options: argparse.Namespace) -> int:
    networks, route = Networks.load(options.model), routefile.load(options.route)
    frames = None
    if options.drive is not None:
        camera = shared.read_camera(options.camera)
        drive = RecordedDrive.open(options.drive, options.topic, camera)
        frames = track(drive.frames(), "replaying", route.steps + 1)
    verdict = forecast.judge(lint.look_over(networks, route, frames))
    if options.json:
        _print_json(verdict.to_dict())
    else:
        sys.stdout.writelines(f"{line}\n" for line in verdict.lines())
    return 0 if verdict.passed else EXIT_FLAGGED


def _print_json(found: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(found) + "\n")
