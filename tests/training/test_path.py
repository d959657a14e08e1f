"""The dead-reckoned path: sums, series and frames against plain geometry."""

import numpy as np
import pytest
import torch

from cbe import geometry
from cbe_training import layout, path
from cbe_training.networks import BehaviorNetworks


def drive(frames: int) -> torch.Tensor:
    """Steps (2, frames, 3) of two smooth drives from the origin."""
    turn = np.stack([np.full(frames, 0.03), 0.06 * np.sin(np.arange(frames) / 12.0)])
    steps = np.stack([np.full_like(turn, 0.1), np.zeros_like(turn), turn], axis=-1)
    steps[:, 0] = 0.0
    return torch.from_numpy(steps).float()


def homogeneous(pose: np.ndarray) -> torch.Tensor:
    """Matrices of poses (N, 3)."""
    turn = pose[:, 2:]
    return layout.frame(
        torch.from_numpy(np.concatenate([pose[:, :2], np.cos(turn), np.sin(turn)], axis=1))
    )


def test_steps_add_up_to_the_pose_they_lead_to() -> None:
    steps = np.random.default_rng(2).normal(0.0, 0.3, (2, 6, 3))
    pose = np.zeros((2, 3))
    added = path.add_up(torch.from_numpy(steps)).numpy()
    for tick in range(6):
        pose = geometry.compose(pose, steps[:, tick])
        turned = geometry.wrap_angle(added[:, tick, 2] - pose[:, 2])
        np.testing.assert_allclose(added[:, tick, :2], pose[:, :2], atol=1e-12)
        np.testing.assert_allclose(turned, 0.0, atol=1e-12)


def test_path_frame_by_frame_equals_that_of_the_whole_drive() -> None:
    steps = drive(120)
    poses = path.add_up(steps)
    expected = path.follow(poses)
    carried = path.Path.begin(steps)
    for frame in range(120):
        carried = path.advance(carried, steps[:, frame])
        torch.testing.assert_close(carried.pose, poses[:, frame], atol=1e-5, rtol=0.0)
        torch.testing.assert_close(carried.series, expected[:, frame], atol=1e-5, rtol=0.0)
    assert (carried.frames == 120.0).all()


def test_a_path_longer_than_the_table_stays_bounded() -> None:
    carried = path.Path.begin(torch.zeros(1, 3))
    for _ in range(path.LONGEST + 50):
        carried = path.advance(carried, torch.tensor([[0.1, 0.0, 0.0]]))
    assert carried.series.isfinite().all()
    assert carried.series.abs().max() < carried.pose[0, 0]


def embedded(steps: torch.Tensor) -> torch.Tensor:
    """z (B, T, 32) of frames that move so; what the LSTM adds to it is noise."""
    torch.manual_seed(0)
    poses = path.add_up(steps)
    encoder = BehaviorNetworks().encoder
    hidden = torch.randn(*poses.shape[:2], encoder.lstm.hidden_size)
    return encoder.embed(hidden, poses, path.follow(poses))


@pytest.mark.parametrize("frames", [17, 65, 129])
def test_embedding_tells_the_path_that_was_driven(frames: int) -> None:
    steps = drive(frames)
    poses = path.add_up(steps)
    embedding = embedded(steps)[:, -1]
    end = layout.pose_of(embedding)
    torch.testing.assert_close(end[:, :2], poses[:, -1, :2])
    torch.testing.assert_close(
        end[:, 2:], torch.stack([poses[:, -1, 2].cos(), poses[:, -1, 2].sin()], dim=-1)
    )
    laid = layout.path_of(embedding, 16)
    driven = poses[:, np.linspace(0, frames - 1, 17).round().astype(int)[1:], :2]
    assert torch.linalg.vector_norm(laid - driven, dim=-1).max() < 0.12
    assert torch.linalg.vector_norm(laid - driven, dim=-1).mean() < 0.03
    length = layout.length_m(embedding).squeeze(-1)
    torch.testing.assert_close(length, torch.full((2,), 0.1 * (frames - 1)), rtol=0.1, atol=0.0)


def test_columns_are_the_path_its_start_and_the_direction_there() -> None:
    steps = drive(65)
    embedding = embedded(steps)[:, -1]
    columns = layout.from_start(embedding)
    torch.testing.assert_close(columns[:, :2, :16].transpose(1, 2), layout.path_of(embedding, 16))
    torch.testing.assert_close(columns[:, :, 16], torch.tensor([[0.0, 0.0, 1.0]] * 2))
    torch.testing.assert_close(columns[:, :, 17], torch.tensor([[1.0, 0.0, 0.0]] * 2))


def test_columns_seen_from_the_end_are_the_same_path() -> None:
    steps = drive(65)
    embedding = embedded(steps)[:, -1]
    end = layout.frame(layout.pose_of(embedding))
    from_end = layout.from_end(embedding)
    torch.testing.assert_close(end @ from_end, layout.from_start(embedding), atol=1e-5, rtol=0.0)
    into = layout.into(embedding) @ layout.from_start(embedding)
    torch.testing.assert_close(into, from_end, atol=1e-5, rtol=0.0)


def test_frames_are_poses() -> None:
    one, other = np.random.default_rng(3).normal(size=(2, 5, 3))
    both = homogeneous(one) @ homogeneous(other)
    torch.testing.assert_close(both, homogeneous(geometry.compose(one, other)))
