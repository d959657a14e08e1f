"""Losses from what was seen while driving equal those from looking again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cbe_training.config import TrainConfig
from cbe_training.drives import Drives
from cbe_training.losses import Minibatch, compute
from cbe_training.networks import BehaviorNetworks
from cbe_training.rollout import roll_out, show

CONFIG = replace(TrainConfig(), without_attractors=0.3, without_embedding=0.3)


def test_kept_features_give_the_same_losses(tmp_path_factory: pytest.TempPathFactory) -> None:
    torch.manual_seed(0)
    drives = Drives.build(range(2), 6, tmp_path_factory.mktemp("drives"))
    networks = BehaviorNetworks()
    rng = np.random.default_rng(0)
    behaviors = show(drives, 4, 8, 2, rng)
    rollouts = roll_out(networks, drives, behaviors, CONFIG, rng, expert_share=0.5)
    chosen = np.arange(4)
    losses = []
    for look_again in (True, False):
        torch.manual_seed(1)
        batch = Minibatch.build(
            behaviors,
            rollouts,
            chosen,
            CONFIG,
            np.random.default_rng(2),
            torch.device("cpu"),
            look_again=look_again,
        )
        losses.append(compute(networks, batch, CONFIG.loss)[1])
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    assert losses[0]["waypoint"] > 0.0
