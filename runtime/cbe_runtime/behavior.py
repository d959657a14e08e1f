"""One segment of a route being repeated: the networks and their state (paper, Sec. III-B, C)."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from cbe_runtime.likeness import NEARER, unlikeness
from cbe_runtime.onward import Onward
from cbe_runtime.sight import Sight

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cbe_runtime.networks import GeneratorState, Networks, Prediction
    from cbe_runtime.route import Route


class Behavior:
    """Repeats segment `segment` of a route from its first frame on; made anew for each.

    While the robot comes nearer to where it was shown to begin, every frame is the first one: from
    0.25 m away that place is read to within 0.12 m, from 0.05 m to within 0.08 m (validation).
    """

    def __init__(self, networks: Networks, route: Route, segment: int) -> None:
        self._networks = networks
        self._route = route
        self._start = route.attractor(segment)
        self._goal = route.attractor(segment + 1)
        self._embedding_goal = route.embedding(segment)
        self._state: GeneratorState | None = None
        self._unlike_start = 0.0  # the first view from the start's, while the robot comes nearer
        self.sight: Sight | None = None  # what was seen last
        self.segment = segment
        self.steps = route.segments[segment].steps
        self.last = segment + 1 == len(route.segments)

    @property
    def pinned(self) -> bool:
        """Whether its end is remembered by its view; a memory without attractors holds zeros."""
        return bool(self._goal.any())

    @property
    def unlike_goal(self) -> float:
        """How unlike its end the last view is, as `likeness.unlikeness`; 0 if unknown."""
        if self.sight is None or not self.pinned:
            return 0.0
        return float(unlikeness(self.sight.attractor, self._goal))

    def waypoint_m(self, prediction: Prediction) -> tuple[float, float]:
        """Where to head for, x and y in base_link: what it says, led on past its end by the next.

        Raises:
            ModelError: an output is not finite.
        """
        begins = self.sight is not None and self.sight.begins  # the end is not yet in reach
        onward = None if begins else self._onward
        x, y = prediction.waypoint_m if onward is None else onward.waypoint_m(prediction)
        return float(x), float(y)

    def look_onward(self) -> None:
        """Read the next path already, in a step without a tick: it took a tenth of a tick's time.

        Raises:
            ModelError: an output is not finite.
        """
        _ = self._onward

    @cached_property
    def _onward(self) -> Onward | None:
        """Unless nothing follows, or where its end lies or the paths lead is not known."""
        if self.last or not self.pinned:
            return None
        own_m = self._networks.path_m(self._embedding_goal)
        next_m = self._networks.path_m(self._route.embedding(self.segment + 1))
        return None if own_m is None or next_m is None else Onward(own_m, next_m)

    @property
    def fresh(self) -> bool:
        """Whether it has seen no frame yet."""
        return self.sight is None

    def tick(self, image: NDArray[np.uint8]) -> Prediction:
        """One tick of all networks on the next frame (64, 64, 3) uint8 RGB.

        Raises:
            ModelError: an output is not finite; the state is then as before.
        """
        sight = Sight.of(self._networks, image, self.sight)
        if self._is_nearer(sight) and not sight.begins:
            sight = Sight.of(self._networks, image, None)
        return self.follow(sight)

    def _is_nearer(self, sight: Sight) -> bool:
        """Whether the robot still comes nearer to where the behavior begins; once no, always no."""
        if not self.pinned or not (sight.begins or self._unlike_start > 0.0):
            return False
        unlike = float(unlikeness(sight.attractor, self._start, 0))
        nearer = sight.begins or unlike < self._unlike_start - NEARER
        self._unlike_start = unlike if nearer else 0.0
        return nearer

    def follow(self, sight: Sight) -> Prediction:
        """One tick of the generator on what the encoder, shared with others, has just seen.

        Raises:
            ModelError: an output is not finite; the state is then as before.
        """
        state = self._state
        if state is None or sight.begins:
            state = self._networks.recall(
                attractor_first=sight.first,
                attractor_start=self._start,
                attractor_goal=self._goal,
                embedding_goal=self._embedding_goal,
            )
        prediction, self._state = self._networks.generate(sight.attractor, sight.embedding, state)
        self.sight = sight
        return prediction
