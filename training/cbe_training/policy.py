"""The networks at the wheel of many robots, one tick at a time, as the runtime runs them."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cbe_training.networks import BehaviorNetworks

CHUNK = 384  # frames convolved at once; more does not fit a small CPU's cache


@dataclass(frozen=True, slots=True)
class Memory:
    """What is kept of D demonstrations: z (D, 32), attractors (D, 400) of first and last frame."""

    embedding: Tensor
    start: Tensor
    goal: Tensor

    def take(self, index: NDArray[np.intp]) -> "Memory":
        """Rows `index`."""
        rows = torch.as_tensor(index, device=self.embedding.device)
        return Memory(self.embedding[rows], self.start[rows], self.goal[rows])


@torch.no_grad()
def memorise(networks: BehaviorNetworks, images: NDArray[np.uint8]) -> Memory:
    """Encode demonstrations (D, T, 64, 64, 3)."""
    device = next(networks.parameters()).device
    embeddings, starts, goals = [], [], []
    each = max(1, CHUNK // images.shape[1])
    for first in range(0, len(images), each):
        some = torch.from_numpy(images[first : first + each]).to(device)
        features = networks.trunk(some.flatten(0, 1))  # (d * T, 48, 16, 16)
        motion = networks.encoder.pair.sequence(features, len(some)).view(*some.shape[:2], -1)
        embedding, _ = networks.encoder(motion)
        ends = features.view(*some.shape[:2], *features.shape[1:])
        embeddings.append(embedding[:, -1])
        starts.append(networks.attractor(ends[:, 0]))
        goals.append(networks.attractor(ends[:, -1]))
    return Memory(torch.cat(embeddings), torch.cat(starts), torch.cat(goals))


class Policy:
    """B robots, robot b repeating row b of the memory."""

    def __init__(self, networks: BehaviorNetworks, memory: Memory) -> None:
        """Start every recurrent state afresh."""
        self._networks = networks
        self._memory = memory
        count, config = len(memory.embedding), networks.config
        self._device = memory.embedding.device
        self._encoder = torch.zeros(2, count, config.encoder_state, device=self._device)
        self._generator = torch.zeros(2, count, config.generator_state, device=self._device)
        self._previous: Tensor | None = None
        self._start = torch.zeros(count, config.relation, device=self._device)

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
        state = self._encoder[:, index]
        embedding, (h, c) = nets.encoder(motion[:, None], (state[:1], state[1:]))
        self._encoder[:, index] = torch.cat([h, c])
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
