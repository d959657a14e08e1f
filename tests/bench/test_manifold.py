"""Embeddings that know where a drive leads are read off well, others are not; in unseen worlds."""

import json

import numpy as np
import pytest

from cbe import geometry
from cbe.camera import MODEL_CAMERA
from cbe.errors import ConfigError, ModelError
from cbe_bench import manifold, scenario
from cbe_bench.cli import main
from cbe_bench.manifold import FEWEST, Behaviors, ManifoldConfig, read_off, spread_out
from cbe_runtime.networks import Networks

COUNT, WORLDS = 400, 40


class Coarse:
    """Stands for `Networks`: embeds a drive as its last image's coarse picture."""

    model_id = "0011223344556677"
    network_period = 2
    segment_steps = 100
    camera = MODEL_CAMERA

    def __init__(self, blind=False):
        self.blind = blind

    def encoder_state(self):
        return None

    def encode(self, image, state):
        coarse = image[::16, ::16].reshape(-1)[:32]  # (4, 4, 3) to (32,)
        z = np.zeros(32) if self.blind else coarse / 255.0
        return np.zeros((1, 1), np.float32), z.astype(np.float32), None

    def attract(self, features):
        return np.zeros(400, np.float32)


def behaviors(embed, *, noise=0.0):
    """Drives that turn more than half round; `embed` makes 32 numbers of x, y, cosine, sine."""
    rng = np.random.default_rng(0)
    last = np.stack(
        [rng.uniform(0, 4, COUNT), rng.uniform(-2, 2, COUNT), rng.uniform(-4, 4, COUNT)], axis=1
    )
    last[:, 2] = geometry.wrap_angle(last[:, 2])
    known = np.column_stack([last[:, :2], np.cos(last[:, 2]), np.sin(last[:, 2])])
    z = embed(known, rng) + noise * rng.normal(size=(COUNT, 32))
    drives = np.stack([np.zeros((COUNT, 3)), last], axis=1)
    return Behaviors(z.astype(np.float32), drives, np.arange(COUNT) % WORLDS, "0" * 16)


def rotated(known, rng):
    return known @ rng.normal(size=(4, 32)) + rng.normal(size=32)


def test_displacement_is_read_off_a_linear_embedding() -> None:
    readout = read_off(behaviors(rotated, noise=0.02), 0)
    for name, unit, limit in (("x", "m", 0.03), ("y", "m", 0.03), ("heading", "deg", 2.0)):
        assert readout[name]["r2"] > 0.99
        assert 0.0 < readout[name][f"median_error_{unit}"] < limit
        assert readout[name][f"median_error_blind_{unit}"] > 10.0 * limit
    assert readout["train"] + readout["test"] == COUNT


def test_an_embedding_that_knows_one_component_only_reads_that_one() -> None:
    readout = read_off(behaviors(lambda known, rng: known[:, :1] @ rng.normal(size=(1, 32))), 0)
    assert readout["x"]["r2"] > 0.99
    assert readout["y"]["r2"] < 0.1
    assert readout["heading"]["r2"] < 0.1


def test_what_is_learnt_of_one_world_does_not_count_in_another() -> None:
    # The embedding names the world and each world has its own direction: nothing carries over.
    made = behaviors(rotated)
    rng = np.random.default_rng(1)
    names, turns = rng.normal(size=(WORLDS, 32)), rng.uniform(-2, 2, WORLDS)
    drives = made.drives.copy()
    drives[:, -1, 1] = turns[made.world]
    told = Behaviors(names[made.world].astype(np.float32), drives, made.world, made.model_id)
    assert read_off(told, 0)["y"]["r2"] < 0.3


def test_drives_of_a_single_world_are_refused() -> None:
    made = behaviors(rotated)
    lone = Behaviors(made.embedding, made.drives, np.zeros(COUNT, np.int64), made.model_id)
    with pytest.raises(ConfigError, match="at least 2 worlds"):
        read_off(lone, 0)


def test_map_repeats_itself() -> None:
    made = behaviors(rotated)
    few = Behaviors(made.embedding[:60], made.drives[:60], made.world[:60], made.model_id)
    points = spread_out(few, 0)
    assert points.shape == (60, 2)
    np.testing.assert_array_equal(points, spread_out(few, 0))


def test_examples_are_far_from_one_another() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(size=(200, 2)), [[50.0, 0.0], [0.0, 50.0]]])
    chosen = manifold._examples(points)
    assert len(set(chosen)) == manifold.EXAMPLES
    assert {200, 201} <= set(chosen)


@pytest.fixture
def two_worlds(monkeypatch):
    monkeypatch.setattr(scenario, "GROUP", FEWEST // 2)
    monkeypatch.setattr(manifold, "GROUP", FEWEST // 2)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_manifold_writes_table_result_and_map(two_worlds, monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(Networks, "load", classmethod(lambda cls, folder: Coarse()))
    path, plot = tmp_path / "manifold.json", tmp_path / "map.png"
    options = ["--steps", "8", "--episodes", str(FEWEST), "--world", "val", "--jobs", "1"]
    assert main(["manifold", *options, "--json", str(path), "--plot", str(plot)]) == 0
    result = json.loads(path.read_text())
    assert result["config"] == {"world": "val", "steps": 8, "episodes": FEWEST, "seed": 0}
    assert result["model_id"] == Coarse.model_id
    readout = result["readout"]
    assert readout["train"] + readout["test"] == FEWEST
    assert all(np.isfinite(readout[name]["r2"]) for name in ("x", "y", "heading"))
    out = capsys.readouterr().out
    for name in ("x", "y", "heading"):
        assert f"{readout[name]['r2']:.3f}" in out
    assert plot.stat().st_size > 10_000


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_model_that_sees_nothing_is_refused(two_worlds, monkeypatch) -> None:
    monkeypatch.setattr(Networks, "load", classmethod(lambda cls, folder: Coarse(blind=True)))
    with pytest.raises(ModelError, match="alike"):
        manifold.embed(ManifoldConfig("val", steps=8, episodes=FEWEST, jobs=1))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"episodes": FEWEST - 1}, "at least 40 episodes"),
        ({"steps": 0}, "at least 1 step"),
        ({"world": "plan.yaml"}, "val or test"),
    ],
)
def test_what_cannot_be_mapped_is_refused_with_a_reason(options, reason) -> None:
    with pytest.raises(ConfigError, match=reason):
        ManifoldConfig(**options)
