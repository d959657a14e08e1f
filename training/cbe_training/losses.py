"""The end-to-end loss (paper, Sec. IV-A) and auxiliary ones on poses read inside."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from cbe import geometry, signature
from cbe_training.config import LossWeights, TrainConfig
from cbe_training.layout import pose_of
from cbe_training.networks import STEP_SCALE, BehaviorNetworks, quantise
from cbe_training.policy import Seen, look
from cbe_training.rollout import Behaviors, Rollouts
from cbe_training.views import GROUP, NOW, TARGET, Steps, Views

LEVELS = (0, 255, 15, 15)  # attractors stored exactly, at 8 bits, at 4 bits
TURN_WEIGHT = 4.0  # more of a waypoint straight to the side than of one straight ahead
OVERLAP_M, OVERLAP_RAD = 2.0, np.radians(60.0)  # beyond, two views share too little


@dataclass(frozen=True, slots=True)
class Minibatch:
    """D behaviors and their B repetitions as tensors; labels in metres and radians."""

    shown: Tensor | Seen  # (D, T, 64, 64, 3) uint8, or what was seen in them
    shown_motion: Tensor  # (D, T, 3) pose of each frame in the one before
    shown_displacement: Tensor  # (D, T, 4) x, y, cos, sin since the first frame
    driven: Tensor | Seen  # (B, S, 64, 64, 3) uint8, or what was seen in them
    motion: Tensor  # (B, S, 3)
    displacement: Tensor  # (B, S, 4)
    goal: Tensor  # (B, S, 4) the goal's pose from each frame
    start: Tensor  # (B, 4) the start's pose from the first frame
    memory: Tensor  # (B,) row of the behavior it was shown
    right: Tensor  # (B,) whether that is the behavior it drives
    valid: Tensor  # (B, S)
    steady: Tensor  # (B, S) valid, and the robot was not carried since it started
    waypoint_m: Tensor  # (B, S, 2)
    progress: Tensor  # (B, S)
    on_route: Tensor  # (B, S)
    levels: Tensor  # (D, 1) attractor quantisation
    keep_attractors: Tensor  # (D, 1) 0 where the memory lacks them
    keep_embedding: Tensor  # (D, 1)

    @classmethod
    def build(
        cls,
        behaviors: Behaviors,
        rollouts: Rollouts,
        chosen: NDArray[np.intp],
        config: TrainConfig,
        rng: np.random.Generator,
        device: torch.device,
        *,
        look_again: bool,
    ) -> "Minibatch":
        """Repetitions `chosen` (B,) and the behaviors they were shown.

        Unless `look_again`, the convolutions are left as they were when driving.
        """
        shown, memory = np.unique(rollouts.shown[chosen], return_inverse=True)
        longest = int(rollouts.frames[chosen].max())
        poses = rollouts.poses[chosen, :longest]
        valid = np.arange(longest) < rollouts.frames[chosen, None]
        frame_poses = behaviors.frame_poses[shown]
        goal = geometry.relative(poses, rollouts.goals[chosen][:, None])
        start = geometry.relative(poses[:, 0], rollouts.starts[chosen])

        lacking = rng.random((len(shown), 1))  # one thing or the other

        def tensor(array: NDArray[np.generic]) -> Tensor:
            wanted = array.astype(np.float32) if array.dtype == np.float64 else array
            return torch.from_numpy(np.ascontiguousarray(wanted)).to(device)

        if look_again:
            shown_seen: Tensor | Seen = tensor(behaviors.images[shown])
            seen: Tensor | Seen = tensor(rollouts.images[chosen, :longest])
        else:
            assert rollouts.seen is not None
            assert rollouts.shown_seen is not None
            shown_seen = rollouts.shown_seen.take(shown)
            seen = Seen(*(kept[:, :longest] for kept in rollouts.seen.take(chosen)))

        return cls(
            shown=shown_seen,
            shown_motion=tensor(_motion(frame_poses)),
            shown_displacement=tensor(_vector(geometry.relative(frame_poses[:, :1], frame_poses))),
            driven=seen,
            motion=tensor(_motion(poses)),
            displacement=tensor(_vector(geometry.relative(poses[:, :1], poses))),
            goal=tensor(_vector(goal)),
            start=tensor(_vector(start)),
            memory=tensor(memory),
            right=tensor(rollouts.shown[chosen] == rollouts.driven[chosen]),
            valid=tensor(valid),
            steady=tensor(valid & (np.arange(longest) < rollouts.carried[chosen, None])),
            waypoint_m=tensor(rollouts.waypoint_m[chosen, :longest]),
            progress=tensor(rollouts.progress[chosen, :longest]),
            on_route=tensor(rollouts.on_route[chosen, :longest].astype(np.float32)),
            levels=tensor(rng.choice(LEVELS, (len(shown), 1)).astype(np.float32)),
            keep_attractors=tensor((lacking >= config.without_attractors).astype(np.float32)),
            keep_embedding=tensor((lacking <= 1.0 - config.without_embedding).astype(np.float32)),
        )


def compute(
    networks: BehaviorNetworks, batch: Minibatch, weights: LossWeights
) -> tuple[Tensor, dict[str, float]]:
    """Weighted loss and its parts."""
    count, longest = batch.valid.shape
    shown_motion, shown_ends = _seen(networks, batch.shown, every=False)
    motion, attractors = _seen(networks, batch.driven, every=True)
    shown_z, _ = networks.encoder(shown_motion)  # (D, T, 32)
    z, _ = networks.encoder(motion)  # (B, S, 32)

    goal_z = shown_z[:, -1]
    # The memory is stored in few bits: half precision noise on z, coarse attractors.
    goal_z = goal_z + 0.01 * torch.randn_like(goal_z)
    ends = quantise(shown_ends.flatten(1), batch.levels).unflatten(1, (2, -1))
    # No attractor and no z is ever all zeros: that says there is none.
    goal_z = (goal_z * batch.keep_embedding)[batch.memory]
    ends = (ends * batch.keep_attractors[..., None])[batch.memory]

    relation, locate = networks.generator.relation, networks.generator.guide.locate
    goal_target = ends[:, 1:].expand(-1, longest, -1).flatten(0, 1)
    goal_relation = relation(attractors.flatten(0, 1), goal_target).view(count, longest, -1)
    start_relation = relation(attractors[:, 0], ends[:, 0])  # (B, relation)
    out = networks.generator(goal_relation, start_relation[:, None], z, goal_z[:, None])

    # Where the robot is lost there is no right waypoint.
    driving = batch.valid & batch.right[:, None] & (batch.on_route > 0.5)
    error = torch.linalg.vector_norm(out.waypoint_m - batch.waypoint_m, dim=-1)
    # Tight turns are rare and forgive least: unweighted, their waypoints came out too straight.
    turning = 1.0 + TURN_WEIGHT * batch.waypoint_m[..., 1].abs() / signature.LOOKAHEAD_M
    related = batch.keep_attractors[batch.memory, 0] > 0.0
    near = _near(batch.goal) & batch.valid & related[:, None]
    pair = torch.ones_like(batch.shown_motion[..., 0], dtype=torch.bool)
    parts = {
        "waypoint": _mean(error, driving * turning),
        "progress": _mean((out.progress - batch.progress).abs(), driving),
        "on_route": _mean(
            F.binary_cross_entropy_with_logits(
                out.on_route_logit, batch.on_route, reduction="none"
            ),
            batch.valid,
        ),
        "motion": 0.5
        * (
            _mean(_motion_error(networks.encoder.step(motion), batch.motion), batch.steady)
            + _mean(_motion_error(networks.encoder.step(shown_motion), batch.shown_motion), pair)
        ),
        "displacement": 0.5
        * (
            _mean(_pose_error(pose_of(z), batch.displacement), batch.steady)
            + _mean(_pose_error(pose_of(shown_z), batch.shown_displacement), pair)
        ),
        "relation": _mean(_pose_error(locate(goal_relation), batch.goal), near)
        + _mean(_pose_error(locate(start_relation), batch.start), _near(batch.start) & related),
    }
    total = torch.stack([getattr(weights, name) * part for name, part in parts.items()]).sum()
    return total, {name: float(part.detach()) for name, part in parts.items()}


def relate(
    networks: BehaviorNetworks,
    views: Views,
    steps: Steps,
    weights: LossWeights,
    rng: np.random.Generator,
) -> tuple[Tensor, dict[str, float]]:
    """Weighted loss and its parts: poses read off pairs of views, and off pairs of frames."""
    device = next(networks.parameters()).device
    attractors = networks.attractor(networks.trunk(torch.from_numpy(views.images).to(device)))
    levels = torch.from_numpy(rng.choice(LEVELS, (len(attractors), 1)).astype(np.float32))
    stored = quantise(attractors, levels.to(device)).view(-1, GROUP, signature.ATTRACTOR_SIZE)
    attractors = attractors.view(stored.shape)
    pose = torch.from_numpy(_vector(views.relation).astype(np.float32)).to(device)
    near = _near(pose)
    relation = networks.generator.relation(attractors[:, NOW][near], stored[:, TARGET][near])
    related = _pose_error(networks.generator.guide.locate(relation), pose[near]).mean()

    before, now = (
        networks.trunk(torch.from_numpy(images).to(device)) for images in (steps.before, steps.now)
    )
    motion = torch.from_numpy(steps.motion.astype(np.float32)).to(device)
    step = networks.encoder.step(networks.encoder.pair(now, before))
    moved = _motion_error(step, motion).mean()
    total = weights.views * (related + moved)
    return total, {"views": float(related.detach()), "view_motion": float(moved.detach())}


def _seen(networks: BehaviorNetworks, frames: Tensor | Seen, *, every: bool) -> Seen:
    return frames if isinstance(frames, Seen) else look(networks, frames, every=every)


def _motion(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose of each frame in the one before, (B, T, 3); zero for the first."""
    before = np.concatenate([poses[:, :1], poses[:, :-1]], axis=1)
    return geometry.relative(before, poses)


def _vector(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (..., 3) as x, y, cos, sin (..., 4)."""
    angle = pose[..., 2:]
    return np.concatenate([pose[..., :2], np.cos(angle), np.sin(angle)], axis=-1)


def _near(pose: Tensor) -> Tensor:
    """Whether views at relative poses (..., 4) overlap enough to be related."""
    aligned = pose[..., 2] > float(np.cos(OVERLAP_RAD))
    return (torch.linalg.vector_norm(pose[..., :2], dim=-1) < OVERLAP_M) & aligned


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.vector_norm(a - b, dim=-1)


def _pose_error(read: Tensor, pose: Tensor) -> Tensor:
    """Of x, y, cos, sin (..., 4): apart, for far views' positions would drown what turns cost."""
    return _distance(read[..., :2], pose[..., :2]) + 2.0 * _distance(read[..., 2:], pose[..., 2:])


def _motion_error(read: Tensor, motion: Tensor) -> Tensor:
    """Of the step `read` against x, y, yaw (..., 3), scaled to be about 1."""
    moved = _distance(read[..., :2], motion[..., :2])
    return STEP_SCALE * (moved + 2.0 * (read[..., 2] - motion[..., 2]).abs())


def _mean(value: Tensor, mask: Tensor) -> Tensor:
    return (value * mask).sum() / mask.sum().clamp(min=1)
