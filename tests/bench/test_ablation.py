"""Parts of a memory go missing exactly, and what they were worth is paired by episode."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.signature import ATTRACTOR_SIZE, EMBEDDING_SIZE, OVERRUN_M
from cbe_bench import evaluation, scenario
from cbe_bench.ablation import CLONED, PARTS
from cbe_bench.cli import main
from cbe_bench.memory import Memory
from cbe_runtime import routefile
from cbe_runtime.networks import Networks, Prediction
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision, Route, Segment

LAST = 7.0  # what the dummy embeds every drive as


class NeedsItsMemory:
    """Stands for `Networks`: drives on and is done after 4 ticks, or never without attractors.

    A `stubborn` one is never done.
    """

    network_period = 2
    segment_steps = 100
    camera = MODEL_CAMERA

    def __init__(self, stubborn=False):
        self.stubborn = stubborn
        self.model_id = ("00", "11")[stubborn] * 8

    def encoder_state(self):
        return None

    def encode(self, image, state):
        return np.zeros((1, 1), np.float32), np.full(EMBEDDING_SIZE, LAST, np.float32), None

    def attract(self, features):
        return np.ones(ATTRACTOR_SIZE, np.float32)

    def recall(self, *, attractor_start, attractor_goal, embedding_goal, **now):
        assert np.all(embedding_goal == LAST) or not embedding_goal.any()
        lost = self.stubborn or not (attractor_start.any() and attractor_goal.any())
        return lost, 0

    def generate(self, attractor, embedding, state):
        assert np.all(attractor != 0.0)
        assert np.all(embedding != 0.0)
        lost, ticks = state
        progress = 0.0 if lost else ticks / 3.0
        end = np.array([0.3 * (1.0 - progress), 0.0, 1.0, 0.0])
        waypoint_m = np.array([end[0] + OVERRUN_M, 0.0])
        return Prediction(waypoint_m, progress, 1.0, end), (lost, ticks + 1)


@pytest.fixture(autouse=True)
def dummies(monkeypatch):
    monkeypatch.setattr(scenario, "GROUP", 2)
    monkeypatch.setattr(evaluation, "GROUP", 2)
    load = classmethod(lambda cls, folder: NeedsItsMemory(folder.name == "cloned"))
    monkeypatch.setattr(Networks, "load", load)
    yield
    evaluation._networks.cache_clear()


@pytest.fixture
def route():
    rng = np.random.default_rng(0)
    precision = Precision()
    attractors = rng.random((3, ATTRACTOR_SIZE), np.float32)
    embeddings = rng.normal(size=(2, EMBEDDING_SIZE)).astype(np.float32)
    return Route(
        "0011223344556677",
        MODEL_CAMERA,
        2,
        precision,
        tuple(map(precision.attractor.pack, attractors)),
        tuple(Segment(precision.embedding.pack(each), 100) for each in embeddings),
    )


@pytest.mark.parametrize("attractor", AttractorPrecision)
@pytest.mark.parametrize("embedding", EmbeddingPrecision)
def test_what_is_missing_is_exactly_zero_in_every_precision(route, attractor, embedding) -> None:
    packed = replace(
        route,
        precision=Precision(attractor, embedding),
        attractors=tuple(attractor.pack(route.attractor(i)) for i in range(3)),
        segments=tuple(Segment(embedding.pack(route.embedding(i)), 100) for i in range(2)),
    )
    no_attractors, no_embedding = (
        routefile.parse(routefile.dump(memory.of(packed)))
        for memory in (Memory.NO_ATTRACTORS, Memory.NO_EMBEDDING)
    )
    assert all(not no_attractors.attractor(i).any() for i in range(3))
    assert all(not no_embedding.embedding(i).any() for i in range(2))
    assert no_attractors.segments == packed.segments
    assert no_embedding.attractors == packed.attractors


def test_without_relocation_only_the_joints_are_missing(route) -> None:
    there = Memory.NO_RELOCATION.of(route)
    assert not there.attractor(1).any()
    assert there.attractors[::2] == route.attractors[::2]
    assert there.segments == route.segments


def test_full_memory_is_the_route_itself(route) -> None:
    assert Memory.FULL.of(route) is route


def ablate(folder, *options):
    path = folder / "ablation.json"
    fixed = ["--jobs", "1", "--world", "val", "--model", ".", "--no-jitter", "--json", str(path)]
    assert main(["ablation", "--steps", "10", "--episodes", "3", *fixed, *options]) == 0
    return json.loads(path.read_text())


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_each_row_is_paired_with_the_full_memory(tmp_path, capsys) -> None:
    result = ablate(tmp_path)
    full, no_attractors, no_embedding = result["rows"]
    assert [row["name"] for row in result["rows"]] == list(PARTS)
    assert "difference" not in full
    assert full["success"] > 0.5
    assert no_attractors["success"] == 0.0
    assert no_attractors["pairs"] == 3
    assert no_attractors["difference"] == -full["success"]
    assert no_embedding["success"] == full["success"]
    assert no_embedding["difference"] == 0.0
    low, high = no_embedding["difference_ci95"]
    assert low < 0.0 < high
    assert [row["config"]["memory"] for row in result["rows"]] == list(PARTS)
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split()[:3] == ["without", "attractors", "0.0%"]
    assert float(lines[2].split()[-4]) == -100.0 * full["success"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_cloned_model_is_a_fourth_row_with_its_whole_memory(tmp_path) -> None:
    full, *_, cloned = ablate(tmp_path, "--cloned", "cloned")["rows"]
    assert cloned["name"] == CLONED
    assert cloned["config"]["memory"] == Memory.FULL
    assert cloned["model_id"] != full["model_id"]
    assert cloned["success"] == 0.0
    assert cloned["difference"] == -full["success"]
