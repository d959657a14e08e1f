"""Entry points of the commands: parse, build the config, call one function, return a code."""

from __future__ import annotations

import argparse
import importlib
import logging
import sys
from collections.abc import Sequence
from typing import NoReturn

from cbe.errors import CbeError, ConfigError

EXIT_REFUSED = 2
"""Bad options, files or peers: the message says what to do."""

Arguments = Sequence[str] | None


class Parser(argparse.ArgumentParser):
    """Refuses options as everything else is refused, wherever they come from."""

    def error(self, message: str) -> NoReturn:
        """Raise what is wrong as a ConfigError."""
        raise ConfigError(f"{message[:300]}; see {self.prog} --help")


def runtime_main(arguments: Arguments = None) -> int:
    """`cbe-runtime`: repeat a route."""
    return _run("cbe-runtime", "command_runtime", arguments)


def teach_main(arguments: Arguments = None) -> int:
    """`cbe-teach`: make a route of a recording or a live drive."""
    return _run("cbe-teach", "command_teach", arguments)


def record_main(arguments: Arguments = None) -> int:
    """`cbe-record`: record what is on the link."""
    return _run("cbe-record", "command_record", arguments)


def replay_main(arguments: Arguments = None) -> int:
    """`cbe-replay`: what would the follower do on a recording."""
    return _run("cbe-replay", "command_replay", arguments)


def view_main(arguments: Arguments = None) -> int:
    """`cbe-view`: show a robot live."""
    return _run("cbe-view", "command_view", arguments)


def route_main(arguments: Arguments = None) -> int:
    """`cbe-route`: look into a route."""
    return _run("cbe-route", "command_route", arguments)


def keys_main(arguments: Arguments = None) -> int:
    """`cbe-keys`: make certificates."""
    return _run("cbe-keys", "command_keys", arguments)


def _run(program: str, module: str, arguments: Arguments) -> int:
    """Import only the command in question: a board starts faster."""
    command = importlib.import_module(f"cbe_runtime.{module}")
    parser = Parser(prog=program, description=command.DESCRIPTION, allow_abbrev=False)
    parser.add_argument("--verbose", action="store_true", help="log more")
    command.add_options(parser)
    tokens = sys.argv[1:] if arguments is None else list(arguments)
    try:
        options = command.parse(parser, tokens) if hasattr(command, "parse") else None
        options = options or parser.parse_args(tokens)
        level = logging.DEBUG if options.verbose else logging.INFO
        logging.basicConfig(level=level, format=f"{program}: %(message)s", stream=sys.stderr)
        code: int = command.run(options)
    except CbeError as error:
        sys.stderr.write(f"{program}: {error}\n")
        return EXIT_REFUSED
    return code
