"""Renews a link that has gone silent: a network is not waited for, it is tried anew."""

from __future__ import annotations

import logging
import math
import threading
import time
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable

    from cbe.link import Link

logger = logging.getLogger(__name__)

SILENT_S = 0.5
"""Five messages of each sensor are missing: the robot stands since 0.2 s ago."""
TRY_S = 0.4
"""Each try is a connection of its own: a network that is back is found by the next one."""
POLL_S = 0.1
CLOSE_S = 2.0
MAX_PAUSE_S = 8.0
"""Between renewals that open but bring nothing: then it is the sensors that are silent."""


class LinkKeeper:
    """Watches one link from a thread of its own, from `with` on."""

    def __init__(self, link: Link, clock: Callable[[], float] = time.monotonic) -> None:
        self._link = link
        self._clock = clock
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link keeper", daemon=True)
        self._renewed_s = -math.inf
        self._pause_s = SILENT_S
        self.renewals = 0
        """How often the link changed to a new session."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._thread.join(CLOSE_S)

    def poll(self) -> None:
        """Renew the link if it is silent; the keeper's thread calls it every `POLL_S`."""
        heard_s = self._link.heard_s
        if heard_s > self._renewed_s:
            self._pause_s = SILENT_S
        # Before the first message there is nothing to miss: opening has just succeeded.
        silent_s = self._clock() - max(heard_s, self._renewed_s)
        if math.isfinite(heard_s) and silent_s > self._pause_s and self._link.renew(TRY_S):
            self.renewals += 1
            self._renewed_s = self._clock()
            self._pause_s = min(2.0 * self._pause_s, MAX_PAUSE_S)
            logger.warning("nothing was heard for %.1f s: the link was renewed", silent_s)

    def _run(self) -> None:
        while not self._closed.wait(POLL_S):
            self.poll()
