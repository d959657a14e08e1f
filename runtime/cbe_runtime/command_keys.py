"""`cbe-keys`: makes the certificates that processes prove themselves with on the link."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cbe_runtime.keys import DAYS, Authority

DESCRIPTION = (
    "Make a certificate for each named process, and at first the authority that signs them. "
    "Copy a process's folder to where it runs and start it with --keys FOLDER; keep the "
    "authority's folder to yourself. See docs/security.md."
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option explains itself in --help."""
    parser.add_argument("folder", type=Path, help="folder of the authority and the certificates")
    parser.add_argument(
        "names", nargs="+", metavar="name", help="process: robot, runtime, operator, ..."
    )
    parser.add_argument(
        "--host",
        action="append",
        default=[],
        help="name or address that others connect to, for a process that listens; may be repeated",
    )
    parser.add_argument(
        "--days", type=int, default=DAYS, help=f"how long they are valid (default {DAYS})"
    )
    parser.add_argument("--renew", action="store_true", help="replace those that exist")


def run(options: argparse.Namespace) -> int:
    """Make the folders and name them.

    Raises:
        ConfigError: see `Authority.issue`.
    """
    authority = Authority(options.folder)
    for name in options.names:
        made = authority.issue(name, tuple(options.host), options.days, options.renew)
        sys.stdout.write(f"{made}\n")
    return 0
