"""`cbe-replay`: makes a black box's decisions again, or says what would be done on any footage."""

from __future__ import annotations

import argparse
import logging
import sys
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from cbe.errors import RecordingError, RouteError
from cbe.robot import STEP_S, Robot
from cbe_runtime import blackbox, decisionlog, routefile
from cbe_runtime import options as shared
from cbe_runtime.comparison import Comparison, Tolerance
from cbe_runtime.drawing import write_png
from cbe_runtime.drive import RecordedDrive
from cbe_runtime.film import Album, Film, draw_all, sheet
from cbe_runtime.follower import Follower
from cbe_runtime.networks import Networks
from cbe_runtime.panel import Panel, Scene
from cbe_runtime.replay import replay
from cbe_runtime.retrace import moments, retrace

if TYPE_CHECKING:
    from collections.abc import Callable

    from cbe_runtime.decision import Decision
    from cbe_runtime.decisionlog import DecisionRecord, Settings
    from cbe_runtime.followerconfig import FollowerConfig
    from cbe_runtime.route import Route

logger = logging.getLogger(__name__)

DESCRIPTION = (
    "Run the follower on a recording without a robot; one JSON line a step, and a summary. Where "
    "the recording holds a runtime's decisions (a black box, or a recording of a repeated drive), "
    "each is made again from what it was made from and must come out the same, bit for bit, on the "
    "same machine; another model (--model) is compared within a tolerance. On any other recording "
    "it says what the follower would do on this footage. Exits with 1 where decisions differ."
)
EXIT_DIFFERENT = 1


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    parser.add_argument(
        "recording", type=Path, help="MCAP file with a camera topic, or the folder of a black box"
    )
    parser.add_argument("--memory", type=Path, required=True, metavar="ROUTE", help="the route")
    parser.add_argument(
        "--footage",
        action="store_true",
        help="pass over recorded decisions: what would be done, starting with the first frame?",
    )
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="film of camera, scan from above, waypoint, progress and state (.mp4, .webm or .avi)",
    )
    parser.add_argument(
        "--sheet", type=Path, metavar="FILE", help="the same for twelve moments on one PNG"
    )
    parser.add_argument("--quiet", action="store_true", help="the summary alone")
    tolerance = Tolerance()
    parser.add_argument(
        "--waypoint-tolerance",
        type=float,
        default=tolerance.waypoint_m,
        metavar="M",
        help=f"between two models' waypoints (default {tolerance.waypoint_m})",
    )
    parser.add_argument(
        "--progress-tolerance",
        type=float,
        default=tolerance.progress,
        metavar="P",
        help=f"between two models' progress (default {tolerance.progress})",
    )
    parser.add_argument("--topic", help="camera topic of footage, where it has several")
    shared.add_camera(parser)
    shared.add_model(parser)


def run(options: argparse.Namespace) -> int:
    """Print the decisions.

    Raises:
        CbeError: recording, route or model is refused.
    """
    networks, route = Networks.load(options.model), routefile.load(options.memory)
    first = None if options.footage else _first_record(options.recording)
    if first is not None:
        route = _as_driven(route, networks, first.settings)
    panel = Panel(str(options.recording.name), [segment.steps for segment in route.segments])
    with ExitStack() as stack:
        film = stack.enter_context(Film(options.video)) if options.video else None
        album = Album() if options.sheet else None
        show = draw_all(film, album, panel)
        if first is None:
            code = _on_footage(options, networks, route, show)
        else:
            code = _again(options, networks, route, first.settings, show)
    if album is not None and (scenes := album.scenes()):
        write_png(sheet(scenes, panel), options.sheet)
    return code


def _again(
    options: argparse.Namespace,
    networks: Networks,
    route: Route,
    recorded: Settings,
    show: Callable[[Scene, bool], None],
) -> int:
    """Make the decisions of a black box again."""
    robot = Robot()
    tolerance = None
    if networks.model_id != recorded.model_id:
        tolerance = Tolerance(options.waypoint_tolerance, options.progress_tolerance)
        logger.info("comparing model %s with %s", networks.model_id, recorded.model_id)

    def make(config: FollowerConfig) -> Follower:
        return Follower(networks, route, robot, config)

    comparison = Comparison(tolerance)
    state = None
    for each in retrace(moments(blackbox.read(options.recording), robot), make):
        record, moment = each.moment.record, each.moment
        differs = comparison.add(each)
        line: dict[str, Any] = {"run": record.run, "step": record.step, "same": None}
        if each.made is not None:
            line["same"] = differs is None
        line |= asdict(each.made or record.decision)
        if differs is not None:
            line["recorded"] = record.decision
        _print(line, options)
        note = f"step {record.step}: {differs.field} differs" if differs else ""
        marked = record.decision.state is not state or (
            differs is not None and differs == comparison.first
        )
        state = record.decision.state
        when = f"{datetime.fromtimestamp(moment.time_ns / 1e9, UTC):%H:%M:%S.%f}"[:-5]
        when += f" UTC, step {record.step}"
        show(
            Scene(each.made or record.decision, moment.observation, moment.picture, when, note),
            marked,
        )
    sys.stderr.write(comparison.summary() + "\n")
    return 0 if comparison.same else EXIT_DIFFERENT


def _on_footage(
    options: argparse.Namespace,
    networks: Networks,
    route: Route,
    show: Callable[[Scene, bool], None],
) -> int:
    """Say what would be done on a recording that somebody else drove."""
    if options.recording.is_dir():
        raise RecordingError(f"{options.recording} is a folder; name one of its files")
    robot = Robot()
    follower = Follower(networks, route, robot)
    drive = RecordedDrive.open(options.recording, options.topic, shared.read_camera(options.camera))
    states: Counter[str] = Counter()
    decision: Decision | None = None
    best = (0, 0.0)
    for step, each in enumerate(replay(follower, drive, robot)):
        marked = decision is None or each.decision.state is not decision.state
        decision = each.decision
        states[f"{decision.state}{f' ({decision.reason})' if decision.reason else ''}"] += 1
        best = max(best, (decision.segment, decision.progress))
        _print(asdict(decision), options)
        when = f"{step * STEP_S:.1f} s"
        show(Scene(decision, each.observation, each.picture, when), marked)
    if decision is None:
        raise RecordingError(f"{options.recording} holds no usable frame of {drive.topic}")
    total = sum(states.values())
    shares = ", ".join(f"{state} {100 * n / total:.0f} %" for state, n in states.most_common())
    sys.stderr.write(
        f"{total} steps ({total * STEP_S:.1f} s) of {drive.topic}: {shares}\n"
        f"it came as far as segment {best[0] + 1} of {decision.segments}, {100 * best[1]:.0f} %, "
        f"and ended {decision.state}{f': {decision.reason}' if decision.reason else ''}\n"
    )
    return 0


def _first_record(path: Path) -> DecisionRecord | None:
    """The first decision in a recording, None where there is none."""
    for message in blackbox.read(path):
        if message.type_name == "cbe/Decision":
            try:
                return decisionlog.parse(message.data)
            except msgspec.DecodeError as error:
                raise RecordingError(
                    f"{path}: its decisions are of another version or damaged ({error}); pass "
                    "over them with --footage"
                ) from error
    return None


def _as_driven(route: Route, networks: Networks, recorded: Settings) -> Route:
    """The route as the networks may drive it, refused where the comparison would mean nothing.

    Raises:
        RouteError: it is not the one that was driven.
    """
    own = decisionlog.route_id(route)
    if networks.model_id == recorded.model_id or route.model_id == recorded.model_id:
        if own != recorded.route_id:
            raise RouteError(
                f"the recorded drive was of route {recorded.route_id}, this is {own}; give that "
                "one, or see with --footage what would be done on this route"
            )
        if route.model_id != networks.model_id:
            logger.warning(
                "the route was taught with model %s: with %s only another precision of the same "
                "weights will do about the same; else teach the drive with that model too",
                route.model_id,
                networks.model_id,
            )
            return replace(
                route, model_id=networks.model_id, network_period=networks.network_period
            )
    return route


def _print(line: dict[str, Any], options: argparse.Namespace) -> None:
    if not options.quiet:
        sys.stdout.write(msgspec.json.encode(line).decode() + "\n")
