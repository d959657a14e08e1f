"""The networks at the wheel of many robots, one tick at a time, as the runtime runs them."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cbe import signature
from cbe_training.networks import BehaviorNetworks, EncoderState
from cbe_training.path import Path

CHUNK = 384  # frames convolved at once; more does not fit a small CPU's cache


class Seen(NamedTuple):
    """What the convolutions make of B sequences of T frames."""

    motion: Tensor  # (B, T, motion)
    attractors: Tensor  # (B, T, 400) of every frame, or (B, 2, 400) of the first and the last

    def take(self, index: NDArray[np.intp]) -> "Seen":
        """Rows `index`."""
        rows = torch.as_tensor(index, device=self.motion.device)
        return Seen(self.motion[rows], self.attractors[rows])


def look(networks: BehaviorNetworks, images: Tensor, *, every: bool) -> Seen:
    """Images (B, T, 64, 64, 3) to features, with attractors of every frame or of the ends."""
    count, steps = images.shape[:2]
    motions, attractors = [], []
    for some in images.split(max(1, CHUNK // steps)):
        features = networks.trunk(some.flatten(0, 1))  # (b * T, 32, 16, 16)
        motions.append(networks.encoder.pair.sequence(features, len(some)))
        if not every:
            features = features.view(len(some), steps, *features.shape[1:])[:, [0, -1]].flatten(
                0, 1
            )
        attractors.append(networks.attractor(features))
    motion = torch.cat(motions).view(count, steps, -1)
    return Seen(motion, torch.cat(attractors).view(count, -1, signature.ATTRACTOR_SIZE))


class Memory(NamedTuple):
    """What is kept of D demonstrations: z (D, 32), attractors (D, 400) of first and last frame."""

    embedding: Tensor
    start: Tensor
    goal: Tensor

    @classmethod
    def of(cls, networks: BehaviorNetworks, seen: Seen) -> "Memory":
        """Encode what was seen of demonstrations."""
        embedding, _ = networks.encoder(seen.motion)
        return cls(embedding[:, -1], seen.attractors[:, 0], seen.attractors[:, -1])

    def take(self, index: NDArray[np.intp]) -> "Memory":
        """Rows `index`."""
        rows = torch.as_tensor(index, device=self.embedding.device)
        return Memory(self.embedding[rows], self.start[rows], self.goal[rows])


@torch.no_grad()
def memorise(networks: BehaviorNetworks, images: NDArray[np.uint8]) -> tuple[Memory, Seen]:
    """Look at demonstrations (D, T, 64, 64, 3) and encode them."""
    device = next(networks.parameters()).device
    seen = look(networks, torch.from_numpy(images).to(device), every=False)
    return Memory.of(networks, seen), seen


class Policy:
    """B robots, robot b repeating row b of the memory.

    `seen` holds what the last tick's rows looked like to the convolutions, one frame each.
    """

    def __init__(self, networks: BehaviorNetworks, memory: Memory) -> None:
        """Start every recurrent state afresh."""
        self._networks = networks
        self._memory = memory
        count, config = len(memory.embedding), networks.config
        self._device = memory.embedding.device
        self._encoder = torch.zeros(2, count, config.encoder_state, device=self._device)
        self._path = Path.begin(memory.embedding)
        self._generator = torch.zeros(2, count, config.generator_state, device=self._device)
        self._previous: Tensor | None = None
        self._start = torch.zeros(count, config.relation, device=self._device)
        self.seen: Seen

    @torch.no_grad()
    def tick(
        self, rows: NDArray[np.intp], images: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Waypoints (b, 2), progress (b,), on-route probability (b,) of the robots in `rows`.

        The first call must name every robot.
        """
        nets = self._networks
        index = torch.as_tensor(rows, device=self._device)
        features = nets.trunk(torch.from_numpy(images).to(self._device))
        attractor = nets.attractor(features)
        first = self._previous is None
        if self._previous is None:
            self._previous = features.clone()
            self._start = nets.generator.relation(attractor, self._memory.start)
        motion = nets.encoder.pair(features, features if first else self._previous[index])
        self._previous[index] = features
        self.seen = Seen(motion[:, None], attractor[:, None])
        h, c = self._encoder[:, index].split(1)
        before = None if first else EncoderState(h, c, Path(*(part[index] for part in self._path)))
        embedding, after = nets.encoder(motion[:, None], before)
        self._encoder[:, index] = torch.cat([after.h, after.c])
        for kept, new in zip(self._path, after.path, strict=True):
            kept[index] = new
        state = self._generator[:, index]
        out = nets.generator(
            nets.generator.relation(attractor, self._memory.goal[index])[:, None],
            self._start[index][:, None],
            embedding,
            self._memory.embedding[index][:, None],
            (state[:1].contiguous(), state[1:].contiguous()),
        )
        self._generator[:, index] = torch.cat(out.state)
        return (
            out.waypoint_m[:, 0].double().cpu().numpy(),
            out.progress[:, 0].double().cpu().numpy(),
            torch.sigmoid(out.on_route_logit[:, 0]).double().cpu().numpy(),
        )
