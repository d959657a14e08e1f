"""Turns a drive's frames into a route, in constant memory (paper, Sec. III-D)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import RouteError
from cbe_runtime.likeness import unlikeness
from cbe_runtime.route import Precision, Route, Segment

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from cbe.camera import CameraModel
    from cbe_runtime.networks import Networks


AROUND_STEPS = 10
"""Half a metre at full speed: where a joint is put, the view should have changed since."""
TURN_COLUMNS = 4
"""About 50 deg: a turn changes views without telling one place from another."""


class Teacher:
    """Cuts a drive into segments and remembers each: embedding, and attractors at the joints.

    Feed one frame a step. With the drive's length known beforehand all segments are equal, at
    most `segment_steps` long; else (teaching live) segments are of that length and what is left
    at the end is halved, so that none is shorter than half of it. Up to two segments of frames
    are held meanwhile; the encoder starts anew at each segment's first frame, and the frame at a
    joint belongs to both segments. Where `adaptive`, segments are half as long at least, and a
    joint is put where the views half a metre before and after are the most unlike its own.
    """

    def __init__(
        self,
        networks: Networks,
        camera: CameraModel,
        *,
        segment_steps: int | None = None,
        total_steps: int | None = None,
        precision: Precision | None = None,
        adaptive: bool = False,
    ) -> None:
        """Prepare to be fed.

        Args:
            networks: of the model that is to repeat the route.
            camera: the one that sees the drive.
            segment_steps: longest segment; the model's own by default.
            total_steps: steps of the whole drive (frames less one), if known.
            precision: how the route stores its numbers.
            adaptive: put joints where they pin the place, rather than at equal distances.
        """
        self._networks = networks
        self._camera = camera
        self._precision = precision or Precision()
        period = networks.network_period
        # Segments begin and end on network ticks, but for the end of the drive.
        self._longest = max((segment_steps or networks.segment_steps) // period, 1) * period
        self._adaptive = adaptive
        self._planned: int | None = None
        if total_steps and not adaptive:
            count = math.ceil(total_steps / self._longest)
            self._planned = self._even(total_steps, count)
        self._frames: list[tuple[int, NDArray[np.uint8]]] = []  # (step, view) on network ticks
        self._last: tuple[int, NDArray[np.uint8]] | None = None
        self._next_step = 0
        self._attractors: list[bytes] = []
        self._segments: list[Segment] = []

    @property
    def steps(self) -> int:
        """Steps fed so far."""
        return max(self._next_step - 1, 0)

    @property
    def segments(self) -> int:
        """Segments finished so far."""
        return len(self._segments)

    def feed(self, image: NDArray[np.uint8]) -> None:
        """Take the next step's view (64, 64, 3) uint8 RGB.

        Raises:
            ModelError: the networks put out a value that is not finite.
        """
        step = self._next_step
        self._next_step += 1
        self._last = (step, image)
        if step % self._networks.network_period != 0:
            return
        self._frames.append(self._last)
        if self._adaptive:
            if self._held_steps >= self._longest + AROUND_STEPS:
                self._cut(self._best_cut())
        elif self._planned is not None:
            if self._held_steps >= self._planned:
                self._cut(self._planned)
        elif self._held_steps >= 2 * self._longest:
            self._cut(self._longest)

    def finish(self, tags: Mapping[str, str] | None = None) -> Route:
        """The route of all that was fed.

        Raises:
            RouteError: fewer than two frames were fed.
            ModelError: the networks put out a value that is not finite.
        """
        if self._last is not None and self._last[0] > self._frames[-1][0]:
            self._frames.append(self._last)
        while self._adaptive and self._held_steps > self._longest:
            self._cut(self._best_cut())
        for parts in range(math.ceil(self._held_steps / self._longest), 0, -1):
            self._cut(self._held_steps if parts == 1 else self._even(self._held_steps, parts))
        if not self._segments:
            raise RouteError(
                f"a route needs a drive of at least two frames that differ, found "
                f"{self._next_step}; drive while teaching, and check the camera"
            )
        return Route(
            model_id=self._networks.model_id,
            camera=self._camera,
            network_period=self._networks.network_period,
            precision=self._precision,
            attractors=tuple(self._attractors),
            segments=tuple(self._segments),
            tags=dict(tags or {}),
        )

    @property
    def _held_steps(self) -> int:
        return self._frames[-1][0] - self._frames[0][0] if self._frames else 0

    def _even(self, steps: int, parts: int) -> int:
        """Steps of each of so many equal parts, rounded up to whole network periods."""
        period = self._networks.network_period
        return math.ceil(steps / parts / period) * period

    def _best_cut(self) -> int:
        """Steps to the held frame, half a segment to one away, whose view pins its place best."""
        first, held = self._frames[0][0], self._held_steps
        latest = max(min(self._longest, held - AROUND_STEPS), 1)
        earliest = min(max(self._longest // 2, held - self._longest), latest)
        seen = {
            step - first: self._attractor_of(image)
            for step, image in self._frames
            if earliest - AROUND_STEPS <= step - first <= latest + AROUND_STEPS
        }
        changes = {
            steps: min(
                (
                    float(unlikeness(seen[steps], seen[other], TURN_COLUMNS))
                    for other in (steps - AROUND_STEPS, steps + AROUND_STEPS)
                    if other in seen
                ),
                default=0.0,
            )
            for steps in seen
            if earliest <= steps <= latest and steps > 0
        }
        return max(changes, key=changes.__getitem__, default=min(self._longest, held))

    def _attractor_of(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        features, _, _ = self._networks.encode(image, self._networks.encoder_state())
        return self._networks.attract(features)

    def _cut(self, steps: int) -> None:
        """Make the first `steps` held steps a segment; its last frame begins the next."""
        end = self._frames[0][0] + steps
        state = self._networks.encoder_state()
        for step, image in self._frames:
            if step > end:
                break
            features, embedding, state = self._networks.encode(image, state)
            if not self._attractors:
                self._attractors.append(self._attractor(features))
        self._attractors.append(self._attractor(features))
        self._segments.append(Segment(self._precision.embedding.pack(embedding), steps))
        self._frames = [frame for frame in self._frames if frame[0] >= end]

    def _attractor(self, features: NDArray[np.float32]) -> bytes:
        return self._precision.attractor.pack(self._networks.attract(features))
