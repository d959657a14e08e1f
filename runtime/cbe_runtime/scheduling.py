"""Lets the loop run on time: before other processes, and not held up by Python's collector."""

from __future__ import annotations

import gc
import logging
import os

logger = logging.getLogger(__name__)

PRIORITY = 1
"""The lowest of SCHED_FIFO: before every ordinary process, after the drivers' threads."""
NICE = 10
"""A runtime's view gives way to it."""


def run_first() -> bool:
    """Run this process and its threads to come before ordinary ones; tells whether it does.

    Needs CAP_SYS_NICE or an `rtprio` limit (the systemd unit gives it); without, the loop shares
    the processor like any other process, and a busy neighbour makes its ticks late.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError):  # not Linux, or not allowed
        first = hasattr(os, "SCHED_FIFO") and os.sched_getscheduler(0) == os.SCHED_FIFO
    else:
        first = True
    logger.info("real-time scheduling: %s", "yes" if first else "not permitted")
    return first


def run_last() -> None:
    """Let others go first, in a process that was started by one that runs first."""
    if hasattr(os, "SCHED_OTHER"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(NICE)


def settle() -> None:
    """Take what exists out of the garbage collector's rounds: all of it stays to the end."""
    gc.collect()
    gc.freeze()
