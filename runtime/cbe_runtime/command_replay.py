"""`cbe-replay`: what the follower would do on a recording, as JSON lines."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import msgspec

from cbe.robot import Robot
from cbe_runtime import options as shared
from cbe_runtime import routefile
from cbe_runtime.drive import RecordedDrive
from cbe_runtime.follower import Follower
from cbe_runtime.networks import Networks
from cbe_runtime.replay import decisions

DESCRIPTION = "Run the follower on a recording without a robot; one JSON line a step."


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    parser.add_argument("recording", type=Path, help="MCAP file with a camera topic")
    parser.add_argument("--memory", type=Path, required=True, metavar="ROUTE", help="the route")
    parser.add_argument("--topic", help="camera topic of the recording, where it has several")
    shared.add_camera(parser)
    shared.add_model(parser)


def run(options: argparse.Namespace) -> int:
    """Print the decisions.

    Raises:
        CbeError: recording, route or model is refused.
    """
    robot = Robot()
    follower = Follower(Networks.load(options.model), routefile.load(options.memory), robot)
    drive = RecordedDrive.open(options.recording, options.topic, shared.read_camera(options.camera))
    for decision in decisions(follower, drive, robot):
        sys.stdout.write(msgspec.json.encode(decision).decode() + "\n")
    return 0
