"""What the encoder has seen since some first frame, whatever behavior is being repeated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cbe_runtime.networks import Networks


@dataclass(frozen=True, slots=True)
class Sight:
    """After a frame: attractors (400,) of it and of the first, embedding z (32,) since then.

    `state` (size,) float32 is what the encoder carries on.
    """

    attractor: NDArray[np.float32]
    first: NDArray[np.float32]
    embedding: NDArray[np.float32]
    state: NDArray[np.float32]

    @property
    def begins(self) -> bool:
        """Whether the frame is the first."""
        return self.first is self.attractor

    @classmethod
    def of(cls, networks: Networks, image: NDArray[np.uint8], before: Sight | None) -> Sight:
        """See the next frame (64, 64, 3) uint8 RGB; the first one where none was seen `before`.

        Raises:
            ModelError: an output is not finite.
        """
        state = networks.encoder_state() if before is None else before.state
        features, embedding, state = networks.encode(image, state)
        attractor = networks.attract(features)
        return cls(attractor, attractor if before is None else before.first, embedding, state)
