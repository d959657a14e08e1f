"""What a robot is left of a route's memory, to see what each part is worth (paper, Sec. IV-B)."""

from dataclasses import replace
from enum import StrEnum

import numpy as np

from cbe.signature import ATTRACTOR_SIZE, EMBEDDING_SIZE
from cbe_runtime.route import Route


class Memory(StrEnum):
    """Which parts of its memory the robot keeps."""

    FULL = "full memory"
    NO_ATTRACTORS = "without attractors"
    NO_EMBEDDING = "without embedding"
    NO_RELOCATION = "without relocation"

    def of(self, route: Route) -> Route:
        """The route with what is missing set to all zeros, which training taught to mean absent.

        Every precision stores zeros exactly.
        """
        if self in {Memory.NO_ATTRACTORS, Memory.NO_RELOCATION}:
            none = route.precision.attractor.pack(np.zeros(ATTRACTOR_SIZE, np.float32))
            kept = list(route.attractors)
            # The ends are no joints: without relocation the robot still knows start and goal.
            missing = slice(None) if self is Memory.NO_ATTRACTORS else slice(1, -1)
            kept[missing] = [none] * len(kept[missing])
            return replace(route, attractors=tuple(kept))
        if self is Memory.NO_EMBEDDING:
            none = route.precision.embedding.pack(np.zeros(EMBEDDING_SIZE, np.float32))
            return replace(
                route, segments=tuple(replace(s, embedding=none) for s in route.segments)
            )
        return route
