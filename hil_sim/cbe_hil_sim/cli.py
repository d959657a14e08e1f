"""`cbe-sim`: a simulated robot on Zenoh."""

import argparse
import logging
import math
import signal
import sys
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA
from cbe.errors import CbeError, ConfigError
from cbe.link import Link
from cbe.linkconfig import LOOPBACK, LinkConfig, loopback
from cbe.linkoptions import add_security, security
from cbe.robot import Robot
from cbe.topics import KeyStyle
from cbe_hil_sim.process import ProcessConfig, RobotProcess
from cbe_hil_sim.simworld import BACKENDS, SimWorld

logger = logging.getLogger(__name__)

DESCRIPTION = (
    "Simulate a robot: publishes camera, camera_info, scan and odom, obeys cmd_vel, and stops by "
    "itself when no command came for 0.3 s."
)
EXIT_REFUSED = 2
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the process's exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s", stream=sys.stderr)
    try:
        return _run(options)
    except CbeError as error:
        sys.stderr.write(f"cbe-sim: {error}\n")
        return EXIT_REFUSED


def _run(options: argparse.Namespace) -> int:
    config = ProcessConfig(options.lockstep, options.raw, options.twist, options.max_seconds)
    link_config = _link_config(options)
    camera = MODEL_CAMERA.scaled(*_camera_size(options.camera_size))
    start = None if options.start is None else _pose(options.start)
    exiting = Event()
    for number in SIGNALS:
        signal.signal(number, lambda *_: exiting.set())
    source = options.scene or options.plan or options.world
    logger.info("loading %s", source)
    world = SimWorld(source, options.backend, camera, gui=options.gui)
    try:
        pose = world.roomiest_pose() if start is None else start
        world.backend.reset(pose[None])
        with Link.open(link_config) as link:
            process = RobotProcess(link, world, Robot(), config, exiting)
            sys.stdout.write(f"ready at {', '.join(link_config.listen or link_config.connect)}\n")
            sys.stdout.flush()
            process.run()
    finally:
        world.close()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cbe-sim", description=DESCRIPTION)
    place = parser.add_argument_group("world").add_mutually_exclusive_group()
    place.add_argument(
        "--world", type=int, default=200_000, metavar="SEED",
        help="generated world (default 200000; up to 99999 were trained on)",
    )  # fmt: skip
    place.add_argument(
        "--scene", type=Path, metavar="DIR", help="folder of OBJ + MTL files, z up, metres"
    )
    place.add_argument(
        "--plan", type=Path, metavar="YAML", help="floor plan as ROS map_server's PGM + YAML"
    )
    parser.add_argument(
        "--backend", choices=BACKENDS, default="bullet",
        help="pybullet's physics and camera (default), or the fast column world without physics",
    )  # fmt: skip
    parser.add_argument(
        "--start", metavar="X,Y,YAW", help="pose in metres and rad (default: the roomiest place)"
    )
    parser.add_argument(
        "--camera-size", default="160x120", metavar="WxH",
        help="pixels, always with the networks' view (default 160x120)",
    )  # fmt: skip
    parser.add_argument("--raw", action="store_true", help="publish raw images in place of JPEG")
    parser.add_argument("--twist", action="store_true", help="obey Twist in place of TwistStamped")
    parser.add_argument(
        "--lockstep", action="store_true",
        help="step 0.1 s for every command stamped with the frame's stamp, as fast as they come; "
        "a frame unanswered for 1 s is published again",
    )  # fmt: skip
    parser.add_argument(
        "--max-seconds", type=float, default=math.inf, metavar="S", help="end after this long"
    )
    window = parser.add_mutually_exclusive_group()
    window.add_argument("--headless", action="store_true", help="no window (default)")
    window.add_argument("--gui", action="store_true", help="open pybullet's window")
    group = parser.add_argument_group("link")
    group.add_argument(
        "--listen", metavar="ENDPOINT", action="append",
        help=f"Zenoh endpoint to listen on as the hub; may be repeated (default {LOOPBACK})",
    )  # fmt: skip
    group.add_argument(
        "--connect", metavar="ENDPOINT", action="append",
        help="Zenoh endpoint to connect to in place of listening; may be repeated",
    )  # fmt: skip
    group.add_argument("--robot", default="robot", help="name in the keys cbe/v1/<robot>/...")
    group.add_argument("--domain", type=int, default=0, help="ROS domain (default 0)")
    group.add_argument(
        "--key-style", choices=[style.value for style in KeyStyle],
        default=KeyStyle.RMW_ZENOH.value,
        help="keys of ROS 2 nodes on rmw_zenoh (default), or bare names as "
        "zenoh-bridge-ros2dds uses",
    )  # fmt: skip
    add_security(parser)
    return parser


def _link_config(options: argparse.Namespace) -> LinkConfig:
    names: dict[str, Any] = {
        "robot": options.robot, "domain": options.domain, "style": KeyStyle(options.key_style),
    } | security(options)  # fmt: skip
    if options.connect and not options.listen:
        return LinkConfig(connect=tuple(options.connect), **names)
    connect = tuple(options.connect or ())
    listen = tuple(options.listen or (loopback(names.get("tls")),))
    return LinkConfig(mode="router", connect=connect, listen=listen, **names)


def _pose(text: str) -> NDArray[np.float64]:
    try:
        pose = np.array([float(word) for word in text.split(",")])
    except ValueError:
        pose = np.empty(0)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ConfigError(f"--start takes x,y,yaw such as 1.5,2.0,0.3; found {text!r}")
    return pose


def _camera_size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise ConfigError(f"--camera-size takes WxH such as 160x120; found {text!r}")
    return int(width), int(height)
