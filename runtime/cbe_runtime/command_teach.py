"""`cbe-teach`: makes a route of a recording or of a live drive."""

from __future__ import annotations

import argparse
import logging
import sys
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from cbe.errors import ConfigError, ModelError
from cbe.link import Link
from cbe_runtime import budget, forecast, lint, routefile
from cbe_runtime import options as shared
from cbe_runtime.command_runtime import exit_on_signals
from cbe_runtime.drive import RecordedDrive
from cbe_runtime.live import LiveDrive
from cbe_runtime.networks import Networks
from cbe_runtime.pathshape import PathShape
from cbe_runtime.perturb import PERTURBATIONS
from cbe_runtime.progressbar import track
from cbe_runtime.route import Precision
from cbe_runtime.teach import Teacher
from cbe_runtime.view import View

if TYPE_CHECKING:
    from cbe_runtime.route import Route

logger = logging.getLogger(__name__)

DESCRIPTION = "Make a route of a recorded drive (any ROS 2 MCAP with a camera), or of a live one."


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    parser.add_argument("recording", type=Path, nargs="?", help="MCAP file of the drive")
    parser.add_argument(
        "--live",
        action="store_true",
        help="teach from the link until Ctrl-C, or the rpc teach_stop",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="route to write (*.msgpack)"
    )
    parser.add_argument("--topic", help="camera topic of the recording, where it has several")
    parser.add_argument(
        "--segment-steps",
        type=int,
        metavar="K",
        help="longest segment in steps of 0.1 s (default: the model's)",
    )
    parser.add_argument(
        "--adaptive",
        action="store_true",
        help="put joints where the view pins the place best, in place of equal segments",
    )
    parser.add_argument(
        "--budget",
        metavar="N B/m",
        help="choose segments and precision so that the route takes no more bytes a metre, as in "
        "100B/m; the drive's length is read off its embeddings",
    )
    parser.add_argument("--name", help="name to store in the route")
    parser.add_argument(
        "--lint",
        action="store_true",
        help="replay the recording with perturbed images too, and say all that was found, as "
        "cbe-route lint does",
    )
    shared.add_precision(parser)
    shared.add_camera(parser)
    shared.add_model(parser)
    shared.add_link(parser)


def run(options: argparse.Namespace) -> int:
    """Teach, save and say what came of it.

    Raises:
        CbeError: recording, camera, model or an option is refused.
    """
    if options.live == (options.recording is not None):
        raise ConfigError("give either a recording or --live")
    if options.segment_steps is not None and options.segment_steps < 2:
        raise ConfigError(f"--segment-steps must be 2 or more; found {options.segment_steps}")
    bytes_per_m = None if options.budget is None else budget.parse(options.budget)
    if options.budget is not None and (options.live or options.segment_steps or options.adaptive):
        raise ConfigError(
            "--budget chooses the segments of a recorded drive, whose length can be known: leave "
            "out --live, --segment-steps and --adaptive"
        )
    networks = Networks.load(options.model)
    routefile.require_writable(options.output)  # a drive is not to be lost for a full disk
    drive = None if options.live else _open(options)
    if drive is None:
        route = _live(options, networks)
    else:
        route = _recorded(options, networks, drive, bytes_per_m)
    size = routefile.save(route, options.output)
    sys.stdout.write(
        f"{options.output}: {size} bytes, {route.steps} steps in {len(route.segments)} segments, "
        f"model {route.model_id}\n"
    )
    if options.recording is not None:
        drive_bytes = options.recording.stat().st_size
        sys.stdout.write(f"the drive's recording: {drive_bytes} bytes\n")
    _look_over(options, networks, route, drive)
    return 0


def _open(options: argparse.Namespace) -> RecordedDrive:
    camera = shared.read_camera(options.camera)
    return RecordedDrive.open(options.recording, options.topic, camera)


def _look_over(
    options: argparse.Namespace, networks: Networks, route: Route, drive: RecordedDrive | None
) -> None:
    """Say how the route may be repeated; of a live drive, whose frames are gone, only a part."""
    frames = track(drive.frames(), "looking over", route.steps + 1) if drive else None
    perturbations = PERTURBATIONS if options.lint else {}  # each costs as much as teaching did
    verdict = forecast.judge(lint.look_over(networks, route, frames, perturbations))
    lines = verdict.lines() if options.lint else [verdict.summary()]
    sys.stdout.writelines(f"{line}\n" for line in lines)
    if not verdict.passed:
        logger.warning("the route may fail: cbe-route lint says where; consider another drive")


def _recorded(
    options: argparse.Namespace,
    networks: Networks,
    drive: RecordedDrive,
    bytes_per_m: float | None,
) -> Route:
    # Equal segments need the drive's length: one pass to count, one to teach.
    frames = sum(1 for _ in track(drive.frames(), "counting frames"))
    route = _taught(options, networks, drive, frames)
    if bytes_per_m is not None:
        shape = None
        with suppress(ModelError):  # older models cannot read a path off an embedding
            shape = PathShape.load(options.model)
        length_m, source = budget.length_m(route, shape)
        plan = budget.plan(route, length_m, bytes_per_m, networks.segment_steps)
        sys.stdout.write(
            f"{length_m:.1f} m ({source}), {plan.size_bytes / length_m:.0f} B/m: segments of "
            f"{plan.segment_steps} steps, attractors {plan.precision.attractor}, embeddings "
            f"{plan.precision.embedding}\n"
        )
        options.segment_steps = plan.segment_steps
        options.attractors = plan.precision.attractor
        options.embeddings = plan.precision.embedding
        route = _taught(options, networks, drive, frames)
    return route


def _taught(
    options: argparse.Namespace, networks: Networks, drive: RecordedDrive, frames: int
) -> Route:
    teacher = _teacher(options, networks, View(drive.camera), total_steps=frames - 1)
    for image in track(drive.frames(), "teaching", frames):
        teacher.feed(image)
    return teacher.finish(_tags(options))


def _live(options: argparse.Namespace, networks: Networks) -> Route:
    ending = Event()
    exit_on_signals(ending)
    view = View(shared.read_camera(options.camera))
    teacher: Teacher | None = None
    with Link.open(shared.link_config(options)) as link:
        drive = LiveDrive(link, view)

        def stop(_request: dict[str, object]) -> dict[str, object]:
            ending.set()
            return {"steps": teacher.steps if teacher else 0}

        link.serve("teach_stop", stop)
        link.declare_alive("teach")
        for image in track(drive.frames(ending), "teaching; frames"):
            if teacher is None:
                teacher = _teacher(options, networks, view)
            teacher.feed(image)
    if teacher is None:
        raise ConfigError("no camera frame came over the link; is the camera publishing?")
    return teacher.finish(_tags(options))


def _teacher(
    options: argparse.Namespace, networks: Networks, view: View, total_steps: int | None = None
) -> Teacher:
    assert view.camera is not None
    return Teacher(
        networks,
        view.camera,
        segment_steps=options.segment_steps,
        total_steps=total_steps,
        precision=Precision(options.attractors, options.embeddings),
        adaptive=options.adaptive,
    )


def _tags(options: argparse.Namespace) -> dict[str, str]:
    return {"name": options.name} if options.name else {}
