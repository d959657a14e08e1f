"""Records what is on the link; a slow disk costs messages, counted, never memory."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from cbe import topics
from cbe_runtime.mcapfile import Recorded

if TYPE_CHECKING:
    from threading import Event

    from cbe.link import Link
    from cbe_runtime.blackbox import Ring
    from cbe_runtime.mcapfile import Recorder

logger = logging.getLogger(__name__)

POLL_S = 0.05
CAPACITY = 512
"""Messages a topic may wait for the disk: close to a minute at 10 Hz."""


OWN = {"status": "cbe/Status", "decision": "cbe/Decision"}
"""Types of our own JSON objects, by the names of their keys."""


class Recording:
    """Subscribes to camera, scan, calibration, odometry, commands and decisions when made."""

    def __init__(self, link: Link, unstamped: bool = False) -> None:
        commands = topics.CMD_VEL_UNSTAMPED if unstamped else topics.CMD_VEL
        wanted = (
            topics.CAMERA,
            topics.CAMERA_RAW,
            topics.SCAN,
            topics.CAMERA_INFO,
            topics.ODOM,
            commands,
        )
        self._streams = [
            (f"/{topic.name}", topic.message.TYPE, link.stream(topic, CAPACITY)) for topic in wanted
        ]
        self._streams += [
            (f"/cbe/{name}", type_name, link.stream_json(name, CAPACITY))
            for name, type_name in OWN.items()
        ]
        # Messages are dated by the wall clock, received by the monotonic one.
        self._wall_ns = time.time_ns() - time.monotonic_ns()

    @property
    def dropped(self) -> int:
        """Messages lost because the disk was too slow."""
        return sum(stream.dropped for _, _, stream in self._streams)

    def run(
        self, recorder: Recorder | Ring, ending: Event, duration_s: float | None = None
    ) -> None:
        """Write until `ending` is set or the time is over, and what has come till then.

        Raises:
            RecordingError: the disk is full or gone.
        """
        end_s = float("inf") if duration_s is None else time.monotonic() + duration_s
        while not ending.wait(min(POLL_S, max(end_s - time.monotonic(), 0.0))):
            self._write(recorder)
            if time.monotonic() >= end_s:
                break
        self._write(recorder)
        if self.dropped:
            logger.warning("%d messages were lost: the disk was too slow", self.dropped)

    def _write(self, recorder: Recorder | Ring) -> None:
        """Empty the queues in the order of receipt."""
        batch = [
            Recorded(
                topic, type_name, sample.payload, self._wall_ns + round(1e9 * sample.received_s)
            )
            for topic, type_name, stream in self._streams
            for sample in stream.drain()
        ]
        for message in sorted(batch, key=lambda each: each.log_time_ns):
            recorder.write(message)
        recorder.flush()
