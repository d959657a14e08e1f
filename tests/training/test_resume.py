"""A run that is cut in two ends as the run that was not."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cbe.errors import ModelError
from cbe_hil_sim.generate import generate
from cbe_training.checkpoint import Learner, load_networks, pack
from cbe_training.config import Learn, TrainConfig
from cbe_training.drives import Drives, cache_name
from cbe_training.team import Team
from cbe_training.train import iterate

# Past cloning, so that the networks' own driving is part of what must repeat.
CONFIG = replace(
    TrainConfig(),
    worlds=2,
    demonstrations=6,
    minibatch=2,
    view_groups=2,
    view_steps=4,
    view_updates=2,
    epochs=1,
    cloning_sequences=1,
    annealing_sequences=1,
)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    return Drives.build(range(2), 8, tmp_path_factory.mktemp("drives"))


def _iterate(learner: Learner, drives: Drives, count: int, what: Learn = Learn.ALL) -> None:
    for _ in range(count):
        iterate(learner, drives, 1.0, Team(), what)
        learner.iteration += 1


@pytest.mark.parametrize("what", Learn)
def test_resumed_run_equals_uninterrupted_run(
    drives: Drives, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: Learn
) -> None:
    monkeypatch.setattr(TrainConfig, "frames", lambda self, sequences: (6, 9))
    device = torch.device("cpu")
    whole = Learner(CONFIG, device)
    _iterate(whole, drives, 1, Learn.VIEWS)  # some parameters start to learn later than others
    _iterate(whole, drives, 2, what)

    first = Learner(CONFIG, device)
    _iterate(first, drives, 1, Learn.VIEWS)
    _iterate(first, drives, 1, what)
    first.save(tmp_path)
    second = Learner(CONFIG, device)
    second.load(tmp_path)
    _iterate(second, drives, 1, what)

    assert second.iteration == 3
    assert second.updates == whole.updates
    for name, value in whole.networks.state_dict().items():
        torch.testing.assert_close(second.networks.state_dict()[name], value, msg=name)
    for name, value in whole.average.state_dict().items():
        torch.testing.assert_close(second.average.state_dict()[name], value, msg=name)


def test_convolutions_rest_while_behaviors_are_learnt(
    drives: Drives, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TrainConfig, "frames", lambda self, sequences: (6, 9))
    learner = Learner(CONFIG, torch.device("cpu"))
    before = {k: v.clone() for k, v in learner.networks.state_dict().items()}
    _iterate(learner, drives, 1, Learn.BEHAVIORS)
    still = {k for k, v in learner.networks.state_dict().items() if v.equal(before[k])}
    convolutions = {k for k in before if k.startswith(("trunk.", "encoder.pair.", "attractor."))}
    assert still == convolutions
    _iterate(learner, drives, 1)
    assert not any(learner.networks.state_dict()[k].equal(before[k]) for k in convolutions)


def test_packed_checkpoint_is_close_and_can_be_trained_on(tmp_path: Path) -> None:
    learner = Learner(CONFIG, torch.device("cpu"))
    learner.save(tmp_path / "run")
    pack(tmp_path / "run", tmp_path / "packed")
    packed = load_networks(tmp_path / "packed").state_dict()
    for name, value in learner.average.state_dict().items():
        torch.testing.assert_close(packed[name], value, atol=1e-3, rtol=1e-3, msg=name)
    again = Learner(CONFIG, torch.device("cpu"))
    again.load(tmp_path / "packed")
    assert again.networks.state_dict()["trunk.stem.weight"].dtype == torch.float32
    stored = sum(path.stat().st_size for path in (tmp_path / "packed").iterdir())
    assert stored < 6_000_000


def test_drives_from_the_cache_equal_those_driven(drives: Drives, tmp_path: Path) -> None:
    driven = Drives.build(range(1), 3, tmp_path)
    cached = Drives.build(range(1), 3, tmp_path)
    assert len(driven.poses) == len(cached.poses) > 0
    for a, b in zip(driven.poses, cached.poses, strict=True):
        assert abs(a - b).max() == 0.0


def test_folder_without_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"state.json is missing; run cbe-train"):
        load_networks(tmp_path)


def test_a_changed_world_is_driven_again() -> None:
    world = generate(0)
    other = world.with_cylinder(3.0, 3.0, 0.2, 1.0, 0)
    assert cache_name([world], 3) != cache_name([other], 3)
