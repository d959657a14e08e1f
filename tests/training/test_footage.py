"""Recorded drives as lessons."""

from pathlib import Path

import numpy as np
import pytest
import torch

from cbe.errors import RecordingError, WorldError
from cbe_training import losses
from cbe_training.config import TrainConfig
from cbe_training.drives import LOOKS, Drives, furnished
from cbe_training.footage import Footage, retell
from cbe_training.networks import BehaviorNetworks

CONFIG = TrainConfig()
STEP_M = 0.04


@pytest.fixture
def footage() -> Footage:
    """Straight drive of 200 steps past noise."""
    views = np.random.default_rng(0).integers(0, 256, (200, 64, 64, 3), np.uint8)
    poses = np.zeros((200, 3))
    poses[:, 0] = STEP_M * np.arange(200)
    return Footage(views, poses)


def test_labels_are_of_the_way_driven(footage: Footage) -> None:
    behaviors, told = retell([footage], 4, 20, 2, CONFIG, np.random.default_rng(0))
    assert behaviors.images.shape == (4, 20, 64, 64, 3)
    assert told.images.shape == (8, 20, 64, 64, 3)
    assert told.on_route.all()
    ahead = told.waypoint_m[:, :8]  # before it is cut short at the end
    assert np.abs(ahead - (CONFIG.lookahead_m, 0.0)).max() < 0.03
    late = told.poses[:, 0, 0] - told.starts[:, 0]
    assert set(np.round(late / STEP_M)) == {0.0, 1.0}
    assert told.progress[:, 0].max() < 0.05
    assert told.progress[:, -1].min() > 0.95
    np.testing.assert_allclose(told.goals[:, 0] - told.starts[:, 0], 38 * STEP_M)


def test_short_recordings_give_shorter_behaviors(footage: Footage) -> None:
    short = Footage(footage.views[:31], footage.poses[:31])
    behaviors, _ = retell([short], 2, 100, 2, CONFIG, np.random.default_rng(0))
    assert behaviors.images.shape[1] == 14


def test_loss_takes_them_like_rollouts(footage: Footage) -> None:
    torch.manual_seed(0)
    networks, rng = BehaviorNetworks(), np.random.default_rng(0)
    behaviors, told = retell([footage], 2, 12, 2, CONFIG, rng)
    batch = losses.Minibatch.build(
        behaviors, told, np.arange(4), CONFIG, rng, torch.device("cpu"), look_again=True
    )
    loss, parts = losses.compute(networks, batch, CONFIG.loss)
    assert torch.isfinite(loss)
    assert parts["waypoint"] > 0.0


def test_file_comes_back_and_no_other_is_taken(footage: Footage, tmp_path: Path) -> None:
    path = tmp_path / "drive.npz"
    np.savez(path, views=footage.views, poses=footage.poses)
    np.testing.assert_array_equal(Footage.load(path).poses, footage.poses)

    np.savez(path, views=footage.views, poses=footage.poses[1:])
    with pytest.raises(RecordingError, match="T finite poses"):
        Footage.load(path)
    np.savez(path, views=footage.views)
    with pytest.raises(RecordingError, match="no footage"):
        Footage.load(path)
    path.write_bytes(b"PK\x03\x04 and nothing")
    with pytest.raises(RecordingError, match="cbe-route frames"):
        Footage.load(path)
    with pytest.raises(RecordingError, match="no footage"):
        Footage.load(tmp_path / "none.npz")


def test_floor_plans_are_driven_in_beside_generated_worlds(tmp_path: Path) -> None:
    rows = np.full((240, 280), 254, np.uint8)
    rows[[0, -1]] = rows[:, [0, -1]] = 0
    rows[:180, 140] = 0
    header = f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode()
    (tmp_path / "plan.pgm").write_bytes(header + rows.tobytes())
    plan = tmp_path / "plan.yaml"
    plan.write_text("image: plan.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    worlds = furnished([plan])
    assert len(worlds) == LOOKS
    assert not np.array_equal(worlds[0].surfaces.texture, worlds[1].surfaces.texture)
    drives = Drives.build(range(1), 3, tmp_path, worlds[:1])
    assert set(drives.world) == {0, 1}
    with pytest.raises(WorldError):
        furnished([tmp_path / "none.yaml"])
