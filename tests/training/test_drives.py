"""Worlds' twins: bins on the drives' ways that leave room to pass."""

import numpy as np
import pytest

from cbe_training.config import TrainConfig
from cbe_training.drives import BIN_PASS_M, Drives
from cbe_training.rollout import roll_out, show


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    return Drives.build(range(2), 6, tmp_path_factory.mktemp("drives"))


def test_twins_have_less_room_somewhere_on_the_drives_and_nowhere_more(drives: Drives) -> None:
    closer = 0
    for world, poses in zip(drives.world, drives.poses, strict=True):
        where = np.full(len(poses), world)
        room = drives.clearance.at(where, poses[:, :2])
        among = drives.clearance.at(where + drives.twins, poses[:, :2])
        assert (among <= room + 1e-6).all()
        closer += int((among < room - BIN_PASS_M / 2).any())
    assert closer > 0


def test_repetitions_meet_bins_that_were_not_shown(drives: Drives) -> None:
    images = []
    for share in (0.0, 1.0):
        rng = np.random.default_rng(0)
        behaviors = show(drives, 6, 60, 2, rng)
        config = TrainConfig(bin_episodes=share, wrong_episodes=0.0, joining_episodes=0.0)
        done = roll_out(None, drives, behaviors, config, rng, expert_share=1.0)
        images.append(done.images)
    assert (images[0] != images[1]).any()
