"""Views of one place: their poses fit together, and a network can learn to relate them."""

import numpy as np
import pytest
import torch

from cbe import geometry
from cbe_training import losses, views
from cbe_training.config import LossWeights
from cbe_training.drives import Drives
from cbe_training.networks import BehaviorNetworks


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    return Drives.build(range(2), 6, tmp_path_factory.mktemp("drives"))


def test_relations_of_a_pair_undo_each_other(drives: Drives) -> None:
    drawn = views.draw(drives, 3, np.random.default_rng(0))
    pairs = list(zip(views.NOW, views.TARGET, strict=True))
    back = [pairs.index((target, now)) for now, target in pairs]
    there_and_back = geometry.compose(drawn.relation, drawn.relation[:, back])
    np.testing.assert_allclose(there_and_back, 0.0, atol=1e-9)
    assert np.ptp(drawn.relation[..., 0]) > 0.5


def test_steps_are_as_short_and_as_curved_as_the_robot_drives(drives: Drives) -> None:
    drawn = views.draw_steps(drives, 80, np.random.default_rng(3))
    length = np.hypot(drawn.motion[:, 0], drawn.motion[:, 1])
    assert drawn.before.shape == drawn.now.shape == (80, 64, 64, 3)
    assert 0.1 < length.max() <= views.LONGEST_STEP_M + 1e-9
    assert (drawn.motion[:, 0] > 0.0).all()
    assert (abs(drawn.motion[:, 2]) <= views.CURVATURE_PER_M * length + 1e-9).all()


def test_steps_that_turn_most_are_hardly_longer_than_others(drives: Drives) -> None:
    motion = views.draw_steps(drives, 600, np.random.default_rng(6)).motion
    length, turn = np.hypot(motion[:, 0], motion[:, 1]), abs(motion[:, 2])
    as_in_tight_turns = (turn > 0.16) & (turn < 0.23)
    assert as_in_tight_turns.sum() > 40
    assert 0.1 <= length[as_in_tight_turns].mean() < 0.112


def test_same_draw_gives_same_views(drives: Drives) -> None:
    one, other = (views.draw(drives, 2, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one.images, other.images)
    np.testing.assert_array_equal(one.relation, other.relation)


def test_networks_learn_to_relate_a_few_views(drives: Drives) -> None:
    torch.manual_seed(0)
    networks = BehaviorNetworks()
    drawn = views.draw(drives, 4, np.random.default_rng(1))
    steps = views.draw_steps(drives, 8, np.random.default_rng(4))
    weights = LossWeights()
    optimizer = torch.optim.AdamW(networks.parameters(), lr=1e-3)
    errors = []
    for _ in range(120):
        error, parts = losses.relate(networks, drawn, steps, weights, np.random.default_rng(2))
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(parts["views"])
    assert errors[-1] < 0.4 * errors[0]
    assert errors[-1] < 0.4
