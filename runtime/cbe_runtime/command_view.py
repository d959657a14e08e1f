"""`cbe-view`: shows a robot live in Foxglove or Lichtblick."""

from __future__ import annotations

import argparse
import logging
import os
from threading import Event, Thread

from cbe.link import Link
from cbe_runtime import options as shared
from cbe_runtime import scheduling
from cbe_runtime.command_runtime import exit_on_signals
from cbe_runtime.liveview import LOOPBACK, LiveView
from cbe_runtime.viewprocess import PORT

logger = logging.getLogger(__name__)

PARENT_POLL_S = 0.5

DESCRIPTION = (
    "Show camera, scan, waypoint, progress, state and alarms live: Foxglove or Lichtblick connect "
    "to ws://localhost:8765 (Foxglove WebSocket), layout in docs/foxglove_layout.json. It only "
    "listens to the robot: however slow a viewer is, nothing else waits for it."
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    parser.add_argument(
        "--port", type=int, default=PORT, help=f"where viewers connect (default {PORT})"
    )
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        help="address to listen at (default 127.0.0.1, this machine alone); anyone who reaches "
        "another can watch, but not drive",
    )
    parser.add_argument("--twist", action="store_true", help="cmd_vel is Twist, not TwistStamped")
    parser.add_argument("--parent", type=int, metavar="PID", help="end with this process")
    shared.add_link(parser)


def run(options: argparse.Namespace) -> int:
    """Show until told to end.

    Raises:
        CbeError: the link or the port cannot be had.
    """
    ending = Event()
    exit_on_signals(ending)
    if options.parent is not None:
        scheduling.run_last()
        Thread(target=_outlive, args=(options.parent, ending), daemon=True).start()
    with Link.open(shared.link_config(options)) as link:
        view = LiveView(link, options.host, options.port, options.twist)
        if options.host != LOOPBACK:
            logger.warning("anyone who reaches %s:%d can watch", options.host, view.port)
        logger.info("showing at ws://%s:%d", options.host, view.port)
        link.declare_alive("view")
        view.run(ending)
    return 0


def _outlive(parent: int, ending: Event) -> None:
    """End once the process that started this one is gone, however it went."""
    while os.getppid() == parent:
        if ending.wait(PARENT_POLL_S):
            return
    ending.set()
