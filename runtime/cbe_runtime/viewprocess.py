"""Starts a view beside a runtime: a process of its own, that ends with it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

_CODE = "import sys; from cbe_runtime.cli import view_main; sys.exit(view_main())"
_ANYWHERE = re.compile(r"(?<=/)(0\.0\.0\.0|\[::\])(?=:)")
PATIENCE_S = 3.0
PORT = 8765
"""Foxglove's own choice."""


def arguments(options: argparse.Namespace) -> list[str]:
    """What `cbe-view` is to be called with to hear what a runtime of these options hears."""
    endpoints = options.connect or [
        _ANYWHERE.sub("127.0.0.1", each) for each in options.listen or ()
    ]
    found = [f"--connect={endpoint}" for endpoint in endpoints]
    found += [f"--robot={options.robot}", f"--domain={options.domain}"]
    found += [f"--key-style={options.key_style}", f"--port={options.view}"]
    found += [f"--keys={options.keys}"] if options.keys else []
    switches = ("twist", "one_way_tls", "any_host")
    found += [f"--{name.replace('_', '-')}" for name in switches if getattr(options, name)]
    return [*found, f"--parent={os.getpid()}"]


@contextmanager
def beside(options: argparse.Namespace) -> Iterator[None]:
    """Show the robot while this holds, where `--view` asks for it; a failing view is no matter."""
    if options.view is None:
        yield
        return
    process = subprocess.Popen(
        [sys.executable, "-c", _CODE, *arguments(options)], stdin=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
