"""`cbe-runtime`: repeats a route on a robot or a simulator."""

from __future__ import annotations

import argparse
import logging
import signal
from contextlib import nullcontext
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from cbe.codec import prepare
from cbe.errors import ConfigError
from cbe.images import load_decoder
from cbe.link import Link
from cbe.messages import CameraInfo, CompressedImage, Image, LaserScan, TwistStamped
from cbe.robot import Robot
from cbe.topics import FRESH_S
from cbe_runtime import options as shared
from cbe_runtime import routefile, scheduling
from cbe_runtime.bookmark import SUFFIX, Bookmark
from cbe_runtime.follower import Follower
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.linkkeeper import LinkKeeper
from cbe_runtime.loop import Loop, LoopConfig
from cbe_runtime.networks import Networks
from cbe_runtime.sensors import Sensors
from cbe_runtime.view import View
from cbe_runtime.viewprocess import PORT, beside

if TYPE_CHECKING:
    from cbe_runtime.route import Route

logger = logging.getLogger(__name__)

DESCRIPTION = "Repeat a taught route: camera and scan in, velocity commands out, at 10 Hz."

BESIDE = Path()
"""`--resume` without a file: beside the route."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    parser.add_argument("--memory", type=Path, metavar="ROUTE", help="the route (*.msgpack)")
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="TOML file: these options by name (memory = ..., key_style = ..., connect = [...]), "
        "a table [camera] and a table [follower]; the command line wins",
    )
    shared.add_model(parser)
    shared.add_camera(parser)
    shared.add_link(parser)
    parser.add_argument(
        "--clock",
        choices=("wall", "sim"),
        default="wall",
        help="tick every 0.1 s (wall, default), or once for every stamped frame of a simulator "
        "(sim); watchdogs stay on wall time",
    )
    parser.add_argument("--lockstep", action="store_true", help="the same as --clock sim")
    parser.add_argument(
        "--max-latency", type=float, metavar="S",
        help="the sensors' clocks agree with this one (chrony, PTP): count ages from the stamps, "
        "and stop for what comes later than S seconds (0 to 0.3) after its stamp; without this, a "
        "constant latency cannot be seen",
    )  # fmt: skip
    parser.add_argument(
        "--view",
        nargs="?",
        type=int,
        const=PORT,
        metavar="PORT",
        help="show the robot live to Foxglove or Lichtblick on this machine, from a process of "
        f"its own (default port {PORT}; needs the extra `view`; cbe-view does so from anywhere)",
    )
    parser.add_argument(
        "--twist", action="store_true", help="publish cmd_vel as Twist instead of TwistStamped"
    )
    parser.add_argument(
        "--wait", action="store_true", help="stay IDLE until the rpc start, instead of starting"
    )
    parser.add_argument(
        "--join",
        action="store_true",
        help="the robot may stand anywhere along the route: look for its place and go on from "
        "there (the rpc relocalise does so at any time)",
    )
    parser.add_argument(
        "--resume",
        nargs="?",
        type=Path,
        const=BESIDE,
        metavar="FILE",
        help="keep the robot's place in a small file (default: beside the route), and after a "
        "restart go on from there",
    )
    parser.add_argument(
        "--exit-when-done",
        action="store_true",
        help="exit with 0 once ARRIVED and standing, with 3 once STOPPED or LOST for --patience "
        "seconds",
    )
    parser.add_argument(
        "--patience", type=float, default=5.0, metavar="S", help="see --exit-when-done (default 5)"
    )


def parse(parser: argparse.ArgumentParser, tokens: list[str]) -> argparse.Namespace:
    """Options of the command line over those of --config over the defaults."""
    options = parser.parse_args(tokens)
    tables = {}
    if options.config is not None:
        tables = shared.read_toml(options.config)
        stored = shared.arguments_of(tables, options.config)
        # A list on the command line replaces the file's instead of growing it.
        given = {token.split("=")[0] for token in tokens}
        stored = [each for each in stored if each.split("=")[0] not in given]
        options = parser.parse_args([*stored, *tokens])
    options.follower = tables.get("follower", {})
    options.camera_table = tables.get("camera")
    return options


def run(options: argparse.Namespace) -> int:
    """Load and check everything, then drive until told to exit.

    Raises:
        CbeError: route, model, camera, link or an option is refused.
    """
    if options.memory is None:
        raise ConfigError("no route given; name one with --memory route.msgpack")
    _check_latency(options)
    camera = shared.read_camera(options.camera)
    follower_config = FollowerConfig()
    if options.config is not None:
        follower_config = shared.follower_config(options.follower, options.config)
        if camera is None and options.camera_table is not None:
            camera = shared.camera_of(options.camera_table, options.config)
    robot = Robot()
    exiting = Event()
    networks = Networks.load(options.model)
    route = routefile.load(options.memory)
    follower = Follower(networks, route, robot, follower_config)
    bookmark = _bookmark(options, route)
    if bookmark is not None:
        bookmark.start(follower)
    elif options.join:
        follower.relocalise()
    elif not options.wait:
        follower.start()
    config = LoopConfig(
        lockstep=options.lockstep or options.clock == "sim",
        unstamped=options.twist,
        exit_when_done=options.exit_when_done,
        patience_s=options.patience,
    )
    received = exit_on_signals(exiting)
    load_decoder()
    prepare(CompressedImage, Image, CameraInfo, LaserScan, TwistStamped)
    if not config.lockstep:
        scheduling.run_first()  # before the link starts its threads
    with Link.open(shared.link_config(options)) as link:
        sensors = Sensors(link, View(camera), robot, options.max_latency)
        watch = bookmark.keep if bookmark else None
        loop = Loop(link, follower, sensors, config, exiting, watch)
        # A simulator in lock-step may be silent for long.
        keeper = nullcontext() if config.lockstep else LinkKeeper(link)
        scheduling.settle()
        with keeper, bookmark or nullcontext(), beside(options):
            code = loop.run()
    if received and options.exit_when_done:
        return 128 + received[0]  # told to go before it was done
    return code


def _bookmark(options: argparse.Namespace, route: Route) -> Bookmark | None:
    if sum((options.wait, options.join, options.resume is not None)) > 1:
        raise ConfigError("--wait, --join and --resume say how to start: give one of them")
    if options.resume is None:
        return None
    beside = options.memory.with_name(options.memory.name + SUFFIX)
    path = beside if options.resume == BESIDE else options.resume
    return Bookmark(path, route)


def _check_latency(options: argparse.Namespace) -> None:
    latency_s = options.max_latency
    if latency_s is None:
        return
    if not 0.0 < latency_s <= FRESH_S:
        raise ConfigError(f"--max-latency is above 0 and at most {FRESH_S:g} s; found {latency_s}")
    if options.lockstep or options.clock == "sim":
        raise ConfigError("--max-latency needs stamps in wall time: leave --clock sim out")


def exit_on_signals(exiting: Event) -> list[int]:
    """Set `exiting` on SIGINT, SIGTERM and SIGHUP; the list then holds their numbers."""
    received: list[int] = []

    def handle(number: int, _frame: object) -> None:
        received.append(number)
        exiting.set()

    for number in SIGNALS:
        signal.signal(number, handle)
    return received
