"""The networks: sequences against single ticks, quantisation, and that they can learn."""

import numpy as np
import pytest
import torch

from cbe import signature
from cbe_training.networks import BehaviorNetworks, quantise
from cbe_training.policy import Policy, memorise


@pytest.fixture(scope="module")
def networks() -> BehaviorNetworks:
    torch.manual_seed(0)
    return BehaviorNetworks().eval()


def test_embedding_of_a_sequence_equals_that_of_single_ticks(networks: BehaviorNetworks) -> None:
    images = np.random.default_rng(0).integers(0, 255, (2, 5, 64, 64, 3), dtype=np.uint8)
    memory, _ = memorise(networks, images)
    policy = Policy(networks, memory)
    rows = np.arange(2)
    for tick in range(5):
        policy.tick(rows, images[:, tick])
    with torch.no_grad():
        path = policy._path
        last = networks.encoder.embed(policy._encoder[0], path.pose, path.series)
    np.testing.assert_allclose(last.numpy(), memory.embedding.numpy(), atol=1e-5)


def test_robots_in_one_batch_do_not_touch_each_other(networks: BehaviorNetworks) -> None:
    rng = np.random.default_rng(1)
    shown = rng.integers(0, 255, (2, 3, 64, 64, 3), dtype=np.uint8)
    seen = rng.integers(0, 255, (4, 2, 64, 64, 3), dtype=np.uint8)
    memory, _ = memorise(networks, shown)
    both = Policy(networks, memory)
    alone = Policy(networks, memory.take(np.array([1])))
    for tick in range(4):
        # Robot 0 misses the last tick: robot 1 must not notice.
        rows = np.array([0, 1]) if tick < 3 else np.array([1])
        waypoint, progress, _ = both.tick(rows, seen[tick][rows])
        expected, expected_progress, _ = alone.tick(np.array([0]), seen[tick][1:])
    np.testing.assert_allclose(waypoint[-1], expected[0], atol=1e-5)
    np.testing.assert_allclose(progress[-1], expected_progress[0], atol=1e-5)


def test_attractor_is_bounded_and_as_large_as_the_signature_says(
    networks: BehaviorNetworks,
) -> None:
    with torch.no_grad():
        attractor = networks.attractor(torch.randn(3, *signature.FEATURES) * 100.0)
    assert attractor.shape == (3, signature.ATTRACTOR_SIZE)
    assert attractor.min() >= 0.0
    assert attractor.max() <= 1.0


def test_quantise_rounds_the_value_and_passes_the_gradient() -> None:
    attractor = torch.rand(3, signature.ATTRACTOR_SIZE, requires_grad=True)
    levels = torch.tensor([[0.0], [255.0], [15.0]])
    rounded = quantise(attractor, levels)
    rounded.sum().backward()
    assert attractor.grad is not None
    torch.testing.assert_close(attractor.grad, torch.ones_like(attractor))
    torch.testing.assert_close(rounded[0], attractor[0])
    scaled = rounded[2] * 15.0
    torch.testing.assert_close(scaled, scaled.round())
    assert (rounded[1] - attractor[1]).abs().max() <= 0.5 / 255.0 + 1e-6
