"""`cbe-record`: writes what is on the link to an MCAP file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from threading import Event

from cbe.link import Link
from cbe_runtime import options as shared
from cbe_runtime.command_runtime import exit_on_signals
from cbe_runtime.mcapfile import Recorder
from cbe_runtime.record import Recording

DESCRIPTION = "Record camera, scan, camera_info, odom and cmd_vel (MCAP, profile ros2)."


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    parser.add_argument("-o", "--output", type=Path, required=True, help="file to write (*.mcap)")
    parser.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help="stop after this long (default: at Ctrl-C or the rpc record_stop)",
    )
    parser.add_argument("--twist", action="store_true", help="cmd_vel is Twist, not TwistStamped")
    shared.add_link(parser)


def run(options: argparse.Namespace) -> int:
    """Record until told to end.

    Raises:
        CbeError: the link cannot be opened or the file not be written.
    """
    ending = Event()
    exit_on_signals(ending)
    with Link.open(shared.link_config(options)) as link, Recorder(options.output) as recorder:
        recording = Recording(link, options.twist)

        def stop(_request: dict[str, object]) -> dict[str, object]:
            ending.set()
            return {"messages": recorder.count, "dropped": recording.dropped}

        link.serve("record_stop", stop)
        link.declare_alive("record")
        recording.run(recorder, ending, options.duration)
    sys.stdout.write(f"{options.output}: {recorder.count} messages\n")
    return 0
