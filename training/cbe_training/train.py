"""The training loop: each iteration rolls out, then learns from what was rolled out.

Every random draw is derived from (seed, iteration), so a run resumed at an iteration's end goes
on as if it had never stopped.
"""

import csv
import ctypes
import logging
import sys
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from cbe_hil_sim.generate import TRAIN_SEEDS, VALIDATION_SEEDS
from cbe_training import losses
from cbe_training.checkpoint import Learner
from cbe_training.config import TrainConfig
from cbe_training.drives import Drives
from cbe_training.networks import BehaviorNetworks
from cbe_training.rollout import Rollouts, roll_out, show
from cbe_training.team import Team

GAPS = (1, 2, 2, 2, 3)  # steps between frames: mostly the runtime's, some slower and faster
VALIDATION_WORLDS, VALIDATION_DRIVES = 10, 20
VALIDATION_STEPS, VALIDATION_BEHAVIORS = (64, 128), 48

logger = logging.getLogger(__name__)


def train(
    config: TrainConfig,
    folder: Path,
    hours: float,
    device: torch.device,
    team: Team,
    decay_hours: float = 0.0,
) -> None:
    """Train for `hours` more, the learning rate falling to nothing over the last `decay_hours`.

    Every worker of the team calls this with the same arguments.
    """
    _keep_freed_memory()
    learner = Learner(config, device)
    if (folder / "state.json").exists():
        learner.load(folder)
        logger.info("resumed at iteration %d", learner.iteration)
    cache = folder.parent / "drives"
    first = config.seed * config.worlds
    seeds = TRAIN_SEEDS[first : first + config.worlds][team.rank :: team.size]
    drives = Drives.build(seeds, config.drives_per_world, cache)
    unseen = Drives.build(VALIDATION_SEEDS[:VALIDATION_WORLDS], VALIDATION_DRIVES, cache)
    start, saved = time.monotonic(), time.monotonic()
    before = learner.seconds
    while (elapsed := team.latest(time.monotonic() - start)) < hours * 3600.0:
        left = hours * 3600.0 - elapsed
        decay = min(1.0, left / (decay_hours * 3600.0)) if decay_hours > 0.0 else 1.0
        row = iterate(learner, drives, decay, team)
        learner.iteration += 1
        learner.seconds = before + elapsed
        if learner.iteration % config.validation_every == 0:
            row |= validate(learner.average, unseen, config, team)
        if team.rank == 0:
            _log(folder, learner, row)
            if time.monotonic() - saved > 240.0:
                learner.save(folder)
                saved = time.monotonic()
    if team.rank == 0:
        learner.save(folder)


def iterate(learner: Learner, drives: Drives, decay: float, team: Team) -> dict[str, float]:
    """One iteration: roll out behaviors, then take a few updates on them; the mean losses."""
    config, iteration = learner.config, learner.iteration
    together = np.random.default_rng([config.seed, iteration])  # the same in every worker
    rng = np.random.default_rng([config.seed, iteration, team.rank])
    torch.manual_seed((config.seed * 1_000_003 + iteration) * team.size + team.rank)
    shortest, longest = config.frames(iteration)
    gap = int(together.choice(GAPS))
    frames = int(together.integers(shortest, longest + 1))
    share = config.expert_share(iteration)
    began = time.monotonic()
    behaviors = show(drives, config.demonstrations // team.size, frames, gap, rng)
    driver = learner.networks if share < 1.0 else None
    rollouts = roll_out(driver, drives, behaviors, config, rng, expert_share=share)
    rolled = time.monotonic()
    sums: dict[str, float] = {}
    for _ in range(config.epochs):
        for chosen in _minibatches(rollouts, config.minibatch // team.size, rng):
            batch = losses.Minibatch.build(behaviors, rollouts, chosen, rng, learner.device)
            warm = min(1.0, (learner.updates + 1) / config.warmup_updates)
            for group in learner.optimizer.param_groups:
                group["lr"] = config.learning_rate * warm * decay
            loss, parts = losses.compute(learner.networks, learner.heads, batch, config.loss)
            learner.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            team.average_gradients(learner.parameters)
            norm = torch.nn.utils.clip_grad_norm_(learner.parameters, config.clip_norm)
            if torch.isfinite(norm):
                learner.optimizer.step()
            learner.updates += 1
            learner.sequences += len(chosen) * team.size
            learner.update_average()
            for name, value in {**parts, "norm": float(norm)}.items():
                sums[name] = sums.get(name, 0.0) + value
    updates = config.epochs * (config.demonstrations // config.minibatch)
    row = {name: value / updates for name, value in sums.items()}
    row |= {"frames": behaviors.images.shape[1], "gap": gap, "expert_share": share}
    row |= {"collided": float(rollouts.collided.mean())}
    row |= {"rollout_s": rolled - began, "update_s": time.monotonic() - rolled}
    return row


def validate(
    networks: BehaviorNetworks, drives: Drives, config: TrainConfig, team: Team
) -> dict[str, float]:
    """Success of the networks alone in unseen worlds, each worker driving its share."""
    row: dict[str, float] = {}
    for steps in VALIDATION_STEPS:
        rng = np.random.default_rng([7, steps, team.rank])
        behaviors = show(drives, VALIDATION_BEHAVIORS // team.size, steps // 2 + 1, 2, rng)
        done = roll_out(networks, drives, behaviors, config, rng, expert_share=0.0, training=False)
        row[f"success_{steps}"] = team.mean(float(done.success.mean()))
        row[f"collided_{steps}"] = team.mean(float(done.collided.mean()))
        row[f"false_arrival_{steps}"] = team.mean(float((done.arrived & ~done.success).mean()))
    return row


def _minibatches(
    rollouts: Rollouts, behaviors: int, rng: np.random.Generator
) -> list[NDArray[np.intp]]:
    """Repetitions of a behavior stay together, so that its demonstration is encoded once."""
    groups = rng.permutation(rollouts.driven.max() + 1).reshape(-1, behaviors)
    return [np.flatnonzero(np.isin(rollouts.driven, group)) for group in groups]


def _log(folder: Path, learner: Learner, row: dict[str, float]) -> None:
    """Append to log.csv, and to TensorBoard's scalars where it is installed."""
    folder.mkdir(parents=True, exist_ok=True)
    row = {
        "iteration": learner.iteration,
        "hours": learner.seconds / 3600.0,
        "sequences": learner.sequences,
        **row,
    }
    names = [*FIELDS, *VALIDATION_FIELDS]
    path = folder / "log.csv"
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", restval="")
        if new:
            writer.writeheader()
        writer.writerow({k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()})
    logger.info(
        "%s", " ".join(f"{k}={v:.3f}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items())
    )


FIELDS = (
    "iteration", "hours", "sequences", "waypoint", "progress", "on_route", "motion",
    "displacement", "shape", "relation", "norm", "frames", "gap", "expert_share", "collided",
    "rollout_s", "update_s",
)  # fmt: skip
VALIDATION_FIELDS = tuple(
    f"{name}_{steps}" for steps in VALIDATION_STEPS for name in ("success", "collided", "false_arrival")
)


def _keep_freed_memory() -> None:
    """Let glibc reuse large blocks: returning them costs a third of a CPU update in page faults."""
    if sys.platform != "linux":
        return
    mallopt = ctypes.CDLL(None).mallopt
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    mallopt(mmap_threshold, 1 << 30)
    mallopt(trim_threshold, 2**31 - 1)
    mallopt(top_pad, 256 << 20)
