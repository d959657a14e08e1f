"""The whole command on a few episodes, with networks that know nothing but to drive on."""

import json

import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.signature import OVERRUN_M
from cbe_bench import evaluation, scenario
from cbe_bench.cli import main
from cbe_runtime.networks import Networks, Prediction

PROMISED = {
    "episodes", "success", "success_paper", "ci95", "spl", "outcomes", "mean_final_error_m",
    "mean_final_error_deg", "min_clearance_m", "config", "model_id",
}  # fmt: skip


class StraightOn:
    """Stands for `Networks`: the waypoint is ahead, and the behavior done after 10 ticks."""

    model_id = "0011223344556677"
    network_period = 2
    segment_steps = 100
    camera = MODEL_CAMERA

    def encoder_state(self):
        return None

    def encode(self, image, state):
        assert image.shape == (64, 64, 3)
        return np.zeros((1, 1), np.float32), np.zeros(32, np.float32), None

    def attract(self, features):
        return np.zeros(400, np.float32)

    def recall(self, **memory):
        return 0

    def generate(self, attractor, embedding, state):
        end, ahead = np.array([0.2, 0.0, 1.0, 0.0]), np.array([0.2 + OVERRUN_M, 0.0])
        return Prediction(ahead, 0.1 * state, 1.0, end), state + 1


@pytest.fixture(autouse=True)
def straight_on(monkeypatch):
    monkeypatch.setattr(scenario, "GROUP", 2)
    monkeypatch.setattr(evaluation, "GROUP", 2)
    monkeypatch.setattr(Networks, "load", classmethod(lambda cls, folder: StraightOn()))
    yield
    evaluation._networks.cache_clear()


def run(command, folder, *options):
    path = folder / f"{command}.json"
    fixed = ["--jobs", "1", "--world", "val", "--model", ".", "--json", str(path)]
    assert main([command, *fixed, *options]) == 0
    return json.loads(path.read_text())


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_single_writes_the_promised_keys_and_repeats_itself(tmp_path, capsys) -> None:
    options = ("--steps", "20", "--episodes", "3", "--noise", "0.5")
    first = run("single", tmp_path, *options, "--plot", str(tmp_path / "sheet.png"))
    assert first.keys() >= PROMISED
    assert json.loads(capsys.readouterr().out).keys() == PROMISED
    assert first["episodes"] == sum(first["outcomes"].values()) == len(first["runs"]) == 3
    assert (tmp_path / "sheet.png").stat().st_size > 1000
    assert run("single", tmp_path, *options) == first


def test_noise_changes_the_ride_but_not_the_episode(tmp_path) -> None:
    options = ("--steps", "20", "--episodes", "2")
    calm = run("single", tmp_path, *options)["runs"]
    rough = run("single", tmp_path, *options, "--noise", "1.0")["runs"]
    for one, other in zip(calm, rough, strict=True):
        assert one["goal"] == other["goal"]
        assert one["final_error_m"] != other["final_error_m"]


def test_narrow_camera_sees_enough_to_drive(tmp_path) -> None:
    result = run("single", tmp_path, "--steps", "20", "--episodes", "2", "--camera", "70x55")
    assert result["config"]["camera"] == "70 x 55 deg"
    assert all(ride["steps"] > 0 and ride["outcome"] != "timeout" for ride in result["runs"])


@pytest.mark.parametrize("asked", ["f32", "u4"])
def test_drives_are_stored_as_exactly_as_asked(tmp_path, monkeypatch, asked) -> None:
    stored, dump = [], evaluation.routefile.dump
    monkeypatch.setattr(
        evaluation.routefile, "dump", lambda route: (stored.append(route), dump(route))[1]
    )
    options = ("--steps", "20", "--episodes", "2", "--precision", asked)
    assert run("single", tmp_path, *options)["config"]["precision"] == asked
    assert [route.precision.attractor.value for route in stored] == [asked] * 2


def test_compare_reads_what_single_writes(tmp_path, capsys) -> None:
    run("single", tmp_path, "--steps", "20", "--episodes", "2")
    capsys.readouterr()
    path = str(tmp_path / "single.json")
    assert main(["compare", path, path]) == 0
    assert "+0.0 points" in capsys.readouterr().out


def test_sweep_lists_and_draws_each_length(tmp_path) -> None:
    plot = tmp_path / "sweep.png"
    result = run("sweep", tmp_path, "--steps", "16,20", "--episodes", "2", "--plot", str(plot))
    assert [row["steps"] for row in result["lengths"]] == [16, 20]
    assert plot.stat().st_size > 1000


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--steps", "0"), "at least 1 episode"),
        (("--steps", "20", "--obstacle-offset", "0.1"), "at least 21 steps"),
        (("--noise", "0.5", "--backend", "bullet"), "leave out --noise"),
        (("--world", "nowhere"), "no world 'nowhere'"),
        (("--camera", "40x30"), "at least half of each is needed"),
    ],
)
def test_bad_options_are_refused_with_a_reason(options, reason, capsys) -> None:
    assert main(["single", *options]) == 1
    assert reason in capsys.readouterr().err
