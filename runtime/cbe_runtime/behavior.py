"""One segment of a route being repeated: the networks and their state (paper, Sec. III-B, C)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cbe_runtime.networks import Networks, Prediction
    from cbe_runtime.route import Route


class Behavior:
    """Repeats segment `segment` of a route from its first frame on; made anew for each."""

    def __init__(self, networks: Networks, route: Route, segment: int) -> None:
        self._networks = networks
        self._start = route.attractor(segment)
        self._goal = route.attractor(segment + 1)
        self._embedding_goal = route.embedding(segment)
        self._first: NDArray[np.float32] | None = None
        self._encoder_state = networks.encoder_state()
        self._generator_state = networks.generator_state()
        self.segment = segment
        self.steps = route.segments[segment].steps
        self.last = segment + 1 == len(route.segments)

    def tick(self, image: NDArray[np.uint8]) -> Prediction:
        """One tick of all networks on the next frame (64, 64, 3) uint8 RGB.

        Raises:
            ModelError: an output is not finite; the state is then as before.
        """
        networks = self._networks
        features, embedding, encoder_state = networks.encode(image, self._encoder_state)
        attractor = networks.attract(features)
        first = attractor if self._first is None else self._first
        prediction, generator_state = networks.generate(
            attractor_now=attractor,
            attractor_first=first,
            attractor_start=self._start,
            attractor_goal=self._goal,
            embedding_now=embedding,
            embedding_goal=self._embedding_goal,
            state=self._generator_state,
        )
        self._first = first
        self._encoder_state = encoder_state
        self._generator_state = generator_state
        return prediction
