"""The parity gate: torch against onnxruntime over real rollouts, recurrent state carried."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor

from cbe import signature
from cbe_export.graphs import encoder_signature, generator_signature
from cbe_training.config import TrainConfig
from cbe_training.drives import unseen
from cbe_training.layout import path_of
from cbe_training.networks import BehaviorNetworks
from cbe_training.rollout import roll_out, show

BEHAVIORS, FRAMES = 4, 40
GRAPHS = ("encoder", "attractor", "recall", "generator", "shape")
SAID = ("waypoint_m", "progress", "on_route", "end")

Arrays = dict[str, NDArray[np.generic]]


class Session(Protocol):
    """What is asked of an `onnxruntime.InferenceSession`."""

    def get_outputs(self) -> Any:
        """Its outputs, in order, with their names."""

    def run(self, names: list[str], inputs: Arrays) -> Any:
        """The outputs of these names."""


@dataclass(frozen=True, slots=True)
class Rides:
    """B repetitions of behaviors: images (B, T, 64, 64, 3), real frames (B,), memory images."""

    images: NDArray[np.uint8]
    frames: NDArray[np.int64]
    shown: NDArray[np.uint8]  # (B, T, 64, 64, 3)

    @classmethod
    def record(cls, networks: BehaviorNetworks, cache: Path) -> "Rides":
        """Let the networks repeat behaviors in validation worlds."""
        rng = np.random.default_rng(0)
        drives = unseen(2, 4, cache)
        behaviors = show(drives, BEHAVIORS, FRAMES, 2, rng)
        done = roll_out(
            networks, drives, behaviors, TrainConfig(), rng, expert_share=0.0, training=False
        )
        return cls(done.images, done.frames, behaviors.images[done.shown])


def worst_difference(networks: BehaviorNetworks, folder: Path, rides: Rides) -> tuple[float, int]:
    """Largest difference of any generator, encoder or shape output, and over how many ticks."""
    sessions = {
        name: onnxruntime.InferenceSession(
            str(folder / f"{name}.onnx"), providers=["CPUExecutionProvider"]
        )
        for name in GRAPHS
    }
    worst, ticks = 0.0, 0
    for images, frames, shown in zip(rides.images, rides.frames, rides.shown, strict=True):
        expected = _run_torch(networks, images[:frames], shown)
        found = replay(networks, sessions, images[:frames], shown)
        worst = max(worst, float(np.abs(expected - found).max()))
        ticks += int(frames)
    return worst, ticks


@torch.no_grad()
def _run_torch(
    networks: BehaviorNetworks,
    images: NDArray[np.uint8],
    shown: NDArray[np.uint8],
) -> NDArray[np.float32]:
    """Waypoint, progress, on_route, end, embedding and its path (T, 56), the sequence at once."""

    def look(frames: NDArray[np.uint8]) -> tuple[Tensor, Tensor]:
        features = networks.trunk(torch.from_numpy(frames))
        embedding, _ = networks.encoder(networks.encoder.pair.sequence(features, 1)[None])
        return embedding, networks.attractor(features)

    goal_z, goal = look(shown)
    z, attractor = look(images)
    relation = networks.generator.relation
    to_goal = relation(attractor, goal[-1:].expand(len(images), -1))[None]
    to_start = relation(attractor[:1], goal[:1])[None]
    out = networks.generator(to_goal, to_start, z, goal_z[:, -1:])
    on_route, end = torch.sigmoid(out.on_route_logit), networks.generator.guide.seen(to_goal)
    parts = [out.waypoint_m, out.progress[..., None], on_route[..., None], end]
    paths = path_of(z, signature.SHAPE_POINTS).flatten(-2)
    return torch.cat([*parts, z, paths], dim=-1)[0].numpy()


def replay(
    networks: BehaviorNetworks,
    sessions: Mapping[str, Session],
    images: NDArray[np.uint8],
    shown: NDArray[np.uint8],
) -> NDArray[np.float32]:
    """The same (T, 56) as onnxruntime has it, tick by tick.

    Of images (T, 64, 64, 3) of a repetition, and `shown` those of the demonstration.
    """

    def look(frames: NDArray[np.uint8]) -> tuple[Arrays, list[Arrays]]:
        state = _zeros(encoder_signature(networks))
        seen: list[Arrays] = []
        for image in frames:
            state["image"] = image[None]
            out = _call(sessions["encoder"], state)
            state["state"] = out["state_next"]
            attractor = _call(sessions["attractor"], {"features": out["features"]})
            path = _call(sessions["shape"], {"embedding": out["embedding"]})
            seen.append({"embedding": out["embedding"], **attractor, **path})
        return seen[-1], seen

    goal, memory = look(shown)
    _, seen = look(images)
    behavior = {
        "attractor_first": seen[0]["attractor"],
        "attractor_start": memory[0]["attractor"],
        "attractor_goal": goal["attractor"],
        "embedding_goal": goal["embedding"],
    }
    state = _zeros(generator_signature(networks)) | _call(sessions["recall"], behavior)
    rows = []
    for now in seen:
        state |= {"attractor_now": now["attractor"], "embedding_now": now["embedding"]}
        out = _call(sessions["generator"], state)
        state["state"] = out["state_next"]
        parts = [*(out[name] for name in SAID), now["embedding"], now["path_m"]]
        rows.append(np.concatenate(parts, axis=None))
    return np.stack(rows)


def _zeros(graph: signature.Graph) -> Arrays:
    return {t.name: np.zeros(t.shape, np.float32) for t in graph.inputs}


def _call(session: Session, inputs: Arrays) -> Arrays:
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, inputs), strict=True))
