"""Commands as child processes that never outlive the demonstration."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Self

from cbe.errors import CbeError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType

COMMANDS = {
    "cbe-sim": "cbe_hil_sim.cli:main",
    "cbe-runtime": "cbe_runtime.cli:runtime_main",
    "cbe-teach": "cbe_runtime.cli:teach_main",
    "cbe-record": "cbe_runtime.cli:record_main",
}
PATIENCE_S = 5.0
LOG_LINES = 15


class ProcessError(CbeError):
    """A command ended early or failed."""


class OverdueError(ProcessError):
    """Something did not happen in time."""


def free_port() -> int:
    """A TCP port of loopback that is free at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Child:
    """One of the project's commands, its output in a log file."""

    def __init__(self, command: str, arguments: Sequence[str], log: Path) -> None:
        """Start `command`, a key of COMMANDS, under the same interpreter as this process."""
        module, function = COMMANDS[command].split(":")
        # sys.argv[0] names the command in its own messages.
        code = (
            f"import sys; sys.argv[0] = {command!r}; from {module} import {function}; "
            f"sys.exit({function}())"
        )
        self.name = command
        self.log = log
        # One thread a library: they would only take each other's turns on few cores.
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
            )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    def require_running(self) -> None:
        """Raise ProcessError if it has ended."""
        if self.returncode is not None:
            raise ProcessError(f"{self.name} ended with code {self.returncode}:\n{self.tail()}")

    def wait(self, timeout_s: float) -> int:
        """Its exit code; OverdueError if it still runs after `timeout_s`."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise OverdueError(
                f"{self.name} did not end within {timeout_s:.0f} s:\n{self.tail()}"
            ) from error

    def signal(self, number: signal.Signals) -> None:
        """Send a signal if it still runs."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def finish(self) -> int:
        """Ask it to end as Ctrl-C does, wait and return its exit code."""
        self.signal(signal.SIGINT)
        return self.wait(2.0 * PATIENCE_S)

    def kill(self) -> None:
        """End it now, whatever it does."""
        self._process.kill()
        self._process.wait()

    def tail(self) -> str:
        """The last lines of its log."""
        lines = self.log.read_text(errors="replace").splitlines()
        return "\n".join(f"  | {line}" for line in lines[-LOG_LINES:]) or "  | (no output)"


class Crew:
    """All children of one `with` block; leaving it ends those that still run."""

    def __init__(self, folder: Path) -> None:
        """Logs go to `folder`."""
        self._folder = folder
        self._children: list[Child] = []

    def start(self, command: str, *arguments: str, log: str | None = None) -> Child:
        """Start a command; its log is named after it unless `log` says otherwise."""
        child = Child(command, arguments, self._folder / f"{log or command}.log")
        self._children.append(child)
        return child

    def __enter__(self) -> Self:
        """The crew itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Interrupt everybody, then kill those that do not listen."""
        running = [child for child in self._children if child.returncode is None]
        try:
            # The last started depends on those before it.
            for child in reversed(running):
                child.signal(signal.SIGINT)
            deadline = time.monotonic() + PATIENCE_S
            for child in reversed(running):
                with contextlib.suppress(ProcessError):
                    child.wait(max(deadline - time.monotonic(), 0.1))
        finally:
            for child in running:
                child.kill()


def rss_mib(pid: int) -> float:
    """Memory that a process holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
