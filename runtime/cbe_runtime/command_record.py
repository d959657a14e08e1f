"""`cbe-record`: writes what is on the link to an MCAP file, or to a black box."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from threading import Event

from cbe.errors import ConfigError
from cbe.link import Link
from cbe_runtime import options as shared
from cbe_runtime.blackbox import Ring, RingConfig
from cbe_runtime.command_runtime import exit_on_signals
from cbe_runtime.mcapfile import Recorder
from cbe_runtime.record import Recording

DESCRIPTION = (
    "Record camera, scan, camera_info, odom, cmd_vel, and the runtime's status and decisions "
    "(MCAP, profile ros2); cbe-replay makes the decisions again. It only listens: however slow "
    "its disk is, nothing else waits for it."
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("-o", "--output", type=Path, help="file to write (*.mcap)")
    target.add_argument(
        "--black-box",
        type=Path,
        metavar="FOLDER",
        help="keep the last minutes only, in files of 20 s of which the oldest are removed; after "
        "a crash or a kill all can be read but for the last second",
    )
    parser.add_argument(
        "--minutes", type=float, default=5.0, metavar="M", help="of a black box (default 5)"
    )
    parser.add_argument(
        "--max-mib", type=int, default=512, metavar="N", help="of a black box (default 512)"
    )
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
    with Link.open(shared.link_config(options)) as link, _recorder(options) as recorder:
        recording = Recording(link, options.twist)

        def stop(_request: dict[str, object]) -> dict[str, object]:
            ending.set()
            return {"messages": recorder.count, "dropped": recording.dropped}

        if options.black_box is None:
            link.serve("record_stop", stop)
        link.declare_alive("record" if options.black_box is None else "black_box")
        recording.run(recorder, ending, options.duration)
    sys.stdout.write(f"{options.output or options.black_box}: {recorder.count} messages\n")
    return 0


def _recorder(options: argparse.Namespace) -> Recorder | Ring:
    if options.black_box is None:
        return Recorder(options.output)
    if not 0.1 <= options.minutes <= 24 * 60 or not 1 <= options.max_mib <= 2**20:
        raise ConfigError("a black box keeps --minutes 0.1 to 1440 in --max-mib 1 to 1048576")
    config = RingConfig(60.0 * options.minutes, options.max_mib * 2**20)
    return Ring(options.black_box, config)
