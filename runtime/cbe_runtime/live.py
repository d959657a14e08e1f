"""A drive as it happens: the views that teaching needs, from the link."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from cbe import topics
from cbe.messages import CameraInfo
from cbe_runtime.drive import StepFrames

if TYPE_CHECKING:
    from collections.abc import Iterator
    from threading import Event

    import numpy as np
    from numpy.typing import NDArray

    from cbe.link import Link
    from cbe_runtime.view import View

logger = logging.getLogger(__name__)

POLL_S = 0.05
CALIBRATION_WAIT_S = 1.5
"""camera_info comes once a second; without it the camera is taken to show the model's view."""


class LiveDrive:
    """The camera on a link, frame by frame; subscribed when made, so that nothing is missed."""

    def __init__(self, link: Link, view: View) -> None:
        self._compressed = link.stream(topics.CAMERA)
        self._raw = link.stream(topics.CAMERA_RAW)
        self._infos = link.latest(topics.CAMERA_INFO)
        self._view = view

    def frames(self, ending: Event) -> Iterator[NDArray[np.uint8]]:
        """Views (64, 64, 3) uint8 RGB, one a step, until `ending` is set.

        Raises:
            CameraError: the camera is unusable.
        """
        if self._view.camera is None:
            self._calibrate()
        frames = StepFrames(self._view)
        source = self._compressed
        while not ending.is_set():
            samples = source.drain(POLL_S)
            if not samples and source is self._compressed:
                # Whichever of the two is heard first is the one to listen to.
                samples = self._raw.drain()
                source = self._raw if samples else self._compressed
            topic = topics.CAMERA if source is self._compressed else topics.CAMERA_RAW
            for sample in samples:
                seen = frames.take(topic.message, sample.payload, round(1e9 * sample.received_s))
                if seen is not None:
                    yield seen
        if frames.damaged or source.dropped:
            logger.warning(
                "left out %d frames that do not decode and %d that came too fast",
                frames.damaged,
                source.dropped,
            )

    def _calibrate(self) -> None:
        received = self._infos.wait(timeout_s=CALIBRATION_WAIT_S)
        if received is not None and isinstance(received.message, CameraInfo):
            self._view.calibrate(received.message)
