"""The training loop: each iteration rolls out, then learns from what was rolled out.

Every random draw is derived from (seed, iteration), so a run resumed at an iteration's end goes
on as if it had never stopped.
"""

import ctypes
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cbe.errors import ConfigError
from cbe_hil_sim.generate import DEPOT_SEEDS, TRAIN_SEEDS
from cbe_training import losses, views
from cbe_training.checkpoint import Learner
from cbe_training.config import NOTHING_ELSE, Learn, Material, TrainConfig
from cbe_training.curve import STEPS, Curve
from cbe_training.drives import Drives, furnished, unseen
from cbe_training.footage import Footage, retell
from cbe_training.networks import BehaviorNetworks
from cbe_training.rollout import OTHER_GAPS, USUAL_GAP, Behaviors, Rollouts, roll_out, show
from cbe_training.team import Team

VALIDATION_WORLDS, VALIDATION_DRIVES = 10, 20
VALIDATION_BEHAVIORS = 48
SAVE_EVERY_S = 240.0

logger = logging.getLogger(__name__)


def train(
    config: TrainConfig,
    folder: Path,
    hours: float,
    device: torch.device,
    team: Team,
    *,
    what: Learn = Learn.ALL,
    decay_hours: float = 0.0,
    bf16: bool = False,
    material: Material = NOTHING_ELSE,
) -> None:
    """Train for `hours` more, the learning rate falling to nothing over the last `decay_hours`.

    Every worker of the team calls this with the same arguments.

    Raises:
        ConfigError: footage is given where the convolutions are not learnt.
    """
    if material.footage and what is not Learn.ALL:
        raise ConfigError(f"footage is learnt from with --learn all; found --learn {what.value}")
    _keep_freed_memory()
    learner = Learner(config, device, bf16=bf16)
    if (folder / "state.json").exists():
        learner.load(folder)
        logger.info("resumed at iteration %d", learner.iteration)
    cache = folder.parent / "drives"
    seeds = _seeds(config)[team.rank :: team.size]
    plans = furnished(material.plans)[team.rank :: team.size]
    drives = Drives.build(seeds, config.drives_per_world, cache, plans)
    footage = [Footage.load(path) for path in material.footage]
    validation = unseen(VALIDATION_WORLDS, VALIDATION_DRIVES, cache)
    start, saved = time.monotonic(), time.monotonic()
    before = learner.seconds
    curve = Curve(folder) if team.rank == 0 else None
    while (elapsed := team.latest(time.monotonic() - start)) < hours * 3600.0:
        left = hours * 3600.0 - elapsed
        decay = min(1.0, left / (decay_hours * 3600.0)) if decay_hours > 0.0 else 1.0
        row = iterate(learner, drives, decay, team, what, footage)
        learner.iteration += 1
        learner.seconds = before + elapsed
        if what is not Learn.VIEWS and learner.iteration % config.validation_every == 0:
            row |= validate(learner.average, validation, config, team)
        if curve is not None:
            counts = {"iteration": learner.iteration, "sequences": learner.sequences}
            row = {**counts, "hours": learner.seconds / 3600.0, **row}
            curve.add(row)
            logger.info("%s", " ".join(f"{name}={value:.4g}" for name, value in row.items()))
            if time.monotonic() - saved > SAVE_EVERY_S:
                learner.save(folder)
                curve.draw()
                saved = time.monotonic()
    if curve is not None:
        learner.save(folder)
        curve.draw()


def _seeds(config: TrainConfig) -> list[int]:
    """Of the worlds that a run with the config's seed learns in."""
    worlds, depots = config.worlds, round(config.depots * config.worlds)
    return [
        *TRAIN_SEEDS[config.seed * worlds :][:worlds],
        *DEPOT_SEEDS["train"][config.seed * depots :][:depots],
    ]


def iterate(
    learner: Learner,
    drives: Drives,
    decay: float,
    team: Team,
    what: Learn = Learn.ALL,
    footage: Sequence[Footage] = (),
) -> dict[str, float]:
    """One iteration: roll out behaviors, then take a few updates on them; the mean losses."""
    config, iteration = learner.config, learner.iteration
    learner.networks.freeze_convolutions(what is Learn.BEHAVIORS)
    torch.manual_seed((config.seed * 1_000_003 + iteration) * team.size + team.rank)
    rng = np.random.default_rng([config.seed, iteration, team.rank])
    learn = Updates(learner, drives, decay, team, rng)
    if what is Learn.VIEWS:
        began = time.monotonic()
        for _ in range(config.view_updates):
            learn.views()
        return learn.means() | {"update_s": time.monotonic() - began}
    together = np.random.default_rng([config.seed, iteration])  # the same in every worker
    shortest, longest = config.frames(learner.sequences)
    share = config.expert_share(learner.sequences)
    driver = learner.networks if share < 1.0 or what is Learn.BEHAVIORS else None
    began = time.monotonic()
    lessons: list[tuple[Behaviors, Rollouts, NDArray[np.intp]]] = []
    collided, frames = [], []
    # Gaps are mixed: from one gap alone a few updates already make every other look slow or fast.
    for gap, part in ((USUAL_GAP, 2), (int(together.choice(OTHER_GAPS)), 1)):
        count = config.demonstrations // team.size * part // 3
        drawn = int(shortest * ((longest + 1) / shortest) ** together.random())  # short ones most
        frames.append(min(drawn, config.longest_steps // gap))
        behaviors = show(drives, count, frames[-1], gap, rng)
        rollouts = roll_out(driver, drives, behaviors, config, rng, expert_share=share)
        collided.append(rollouts.collided.mean())
        for _ in range(config.epochs):
            for chosen in _minibatches(rollouts, config.minibatch // team.size, rng):
                lessons.append((behaviors, rollouts, chosen))
    if footage:
        count = config.demonstrations // team.size // 3
        told = retell(footage, count, frames[0], USUAL_GAP, config, rng)
        for chosen in _minibatches(told[1], config.minibatch // team.size, rng):
            lessons.append((*told, chosen))
    rolled = time.monotonic()
    for index in together.permutation(len(lessons)):
        behaviors, rollouts, chosen = lessons[index]
        learn.behaviors(behaviors, rollouts, chosen, what)
    row = learn.means()
    row |= {"frames": float(np.mean(frames)), "gap": gap, "expert_share": share}
    row |= {"collided": float(np.mean(collided))}
    row |= {"rollout_s": rolled - began, "update_s": time.monotonic() - rolled}
    return row


class Updates:
    """The updates of one iteration and the means of their losses."""

    def __init__(
        self,
        learner: Learner,
        drives: Drives,
        decay: float,
        team: Team,
        rng: np.random.Generator,
    ) -> None:
        self._learner, self._drives, self._decay = learner, drives, decay
        self._team, self._rng = team, rng
        self._sums: dict[str, float] = {}
        self._count = 0

    def behaviors(
        self, behaviors: Behaviors, rollouts: Rollouts, chosen: NDArray[np.intp], what: Learn
    ) -> None:
        """Learn from repetitions `chosen` and, beside them, from views."""
        learner, config = self._learner, self._learner.config
        batch = losses.Minibatch.build(
            behaviors,
            rollouts,
            chosen,
            config,
            self._rng,
            learner.device,
            look_again=what is Learn.ALL,
        )
        with self._arithmetic():
            loss, parts = losses.compute(learner.networks, batch, config.loss)
        learner.sequences += len(chosen) * self._team.size
        if what is Learn.ALL:
            seeing, also = self._relate(1)
            loss, parts = loss + seeing, parts | also
        self._step(loss, parts)

    def views(self) -> None:
        """Learn from views alone."""
        self._step(*self._relate(self._learner.config.views_alone))

    def means(self) -> dict[str, float]:
        """Mean of each loss and of the gradient's norm."""
        return {name: value / self._count for name, value in self._sums.items()}

    def _relate(self, times: int) -> tuple[Tensor, dict[str, float]]:
        learner, config, rng = self._learner, self._learner.config, self._rng
        each = self._team.size
        seen = views.draw(self._drives, times * config.view_groups // each, rng)
        steps = views.draw_steps(self._drives, times * config.view_steps // each, rng)
        with self._arithmetic():
            return losses.relate(learner.networks, seen, steps, config.loss, rng)

    def _step(self, loss: Tensor, parts: dict[str, float]) -> None:
        learner, config = self._learner, self._learner.config
        warm = min(1.0, (learner.updates + 1) / config.warmup_updates)
        for group in learner.optimizer.param_groups:
            group["lr"] = config.learning_rate * warm * self._decay
        learner.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._team.average_gradients(learner.parameters)
        norm = torch.nn.utils.clip_grad_norm_(learner.parameters, config.clip_norm)
        if torch.isfinite(norm):
            learner.optimizer.step()
        learner.updates += 1
        learner.update_average()
        for name, value in {**parts, "norm": float(norm)}.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1

    def _arithmetic(self) -> torch.autocast:
        learner = self._learner
        return torch.autocast(learner.device.type, torch.bfloat16, enabled=learner.bf16)


def validate(
    networks: BehaviorNetworks, drives: Drives, config: TrainConfig, team: Team
) -> dict[str, float]:
    """Success of the networks alone in unseen worlds, each worker driving its share."""
    row: dict[str, float] = {}
    for steps in STEPS:
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


def _keep_freed_memory() -> None:
    """Let glibc reuse large blocks: returning them costs a third of a CPU update in page faults."""
    if sys.platform != "linux":
        return
    mallopt = ctypes.CDLL(None).mallopt
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    mallopt(mmap_threshold, 1 << 30)
    mallopt(trim_threshold, 2**31 - 1)
    mallopt(top_pad, 256 << 20)
