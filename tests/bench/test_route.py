"""Long routes: stored sizes are the file's, joints are shared, missing ones are told apart."""

import json

import numpy as np
import pytest

from cbe_bench import route
from cbe_bench.cli import main
from cbe_bench.evaluation import Stored
from cbe_runtime import routefile
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision

PROMISED = {
    "episodes", "success", "success_paper", "ci95", "outcomes", "bytes_mean", "bytes_per_m",
    "attractors_mean", "segments_mean", "steps_mean", "compression_ratio", "config", "model_id",
}  # fmt: skip
LENGTH_M = 6.0

pytestmark = pytest.mark.usefixtures("counting")


def run(folder, *options, command="route"):
    path = folder / f"{command}.json"
    fixed = ["--jobs", "1", "--world", "val", "--model", ".", "--json", str(path)]
    assert main([command, "--length-m", str(LENGTH_M), "--episodes", "2", *fixed, *options]) == 0
    return json.loads(path.read_text())


def view(value):
    return np.full((64, 64, 3), value, np.uint8)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_route_writes_the_promised_keys(tmp_path, capsys, counting) -> None:
    result = run(tmp_path, "--obstacles", "1", "--plot", str(tmp_path / "sheet.png"))
    assert result.keys() >= PROMISED
    assert json.loads(capsys.readouterr().out).keys() == result.keys() - {"runs"}
    assert result["episodes"] == sum(result["outcomes"].values()) == len(result["runs"]) == 2
    assert result["config"]["segment_steps"] == counting.segment_steps
    assert result["config"]["obstacles"] == 1
    assert abs(result["length_mean_m"] - LENGTH_M) < 0.25 * LENGTH_M
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_segments_are_no_longer_than_asked_and_share_their_attractors(tmp_path) -> None:
    for one in run(tmp_path, "--segment-steps", "30")["runs"]:
        stored = one["route"]
        assert stored["segments"] == -(-stored["steps"] // 30) > 3
        assert stored["attractors"] == stored["segments"] + 1


def test_size_is_that_of_the_whole_file(counting) -> None:
    views = [view(i) for i in range(91)]
    for attractor in AttractorPrecision:
        precision = route.precision_of(attractor)
        taught = route.Teaching(30, precision)(counting, views)
        least = 4 * attractor.size_bytes + 3 * precision.embedding.size_bytes
        assert least < len(routefile.dump(taught)) < least + 250


def test_precision_is_of_all_numbers_or_of_attractors() -> None:
    assert route.precision_of(AttractorPrecision.F32).embedding is EmbeddingPrecision.F32
    assert route.precision_of(AttractorPrecision.U4).embedding is EmbeddingPrecision.F16


def test_coarser_attractors_make_smaller_files_of_the_same_drives(tmp_path) -> None:
    exact, coarse = (run(tmp_path, "--precision", name) for name in ("f32", "u4"))
    assert coarse["bytes_mean"] < 0.25 * exact["bytes_mean"]
    for one, other in zip(exact["runs"], coarse["runs"], strict=True):
        assert one["goal"] == other["goal"]
        assert one["route"]["steps"] == other["route"]["steps"]


@pytest.mark.parametrize(("options", "at_joints"), [((), True), (("--no-relocation",), False)])
def test_relocation_is_what_joints_attractors_are_for(
    tmp_path, counting, options, at_joints
) -> None:
    result = run(tmp_path, "--segment-steps", "30", "--no-jitter", *options)
    starts = [index for index, (start, _) in enumerate(counting.given) if start]
    assert counting.given[0] == (True, at_joints)
    assert (len(starts) == len(counting.given)) is at_joints
    assert ((False, False) in counting.given) is not at_joints
    names = {True: "full memory", False: "without relocation"}
    assert result["config"]["memory"] == names[at_joints]


def test_memory_is_counted_over_all_drives() -> None:
    stored = [
        Stored(length_m=20.0, steps=399, segments=4, attractors=5, size_bytes=2000),
        Stored(length_m=10.0, steps=199, segments=4, attractors=5, size_bytes=1000),
    ]
    assert route.memory(stored) == {
        "bytes_mean": 1500.0,
        "bytes_per_m": 100.0,
        "attractors_mean": 5.0,
        "segments_mean": 4.0,
        "steps_mean": 299.0,
        "length_mean_m": 15.0,
        "compression_ratio": 75.0,  # (400 / 4 + 200 / 4) / 2
    }


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_compression_lists_and_draws_each_length_in_each_precision(tmp_path, capsys) -> None:
    plot = tmp_path / "compression.png"
    which = ("--segment-steps", "30,60", "--precision", "u8,u4")
    options = (*which, "--episodes", "1", "--plot", str(plot))
    rows = run(tmp_path, *options, command="compression")["rows"]
    named = [(row["segment_steps"], row["precision"]) for row in rows]
    assert named == [(30, "u8"), (60, "u8"), (30, "u4"), (60, "u4")]
    assert (
        rows[0]["compression_ratio"]
        < rows[1]["compression_ratio"]
        == (rows[3]["compression_ratio"])
    )
    assert rows[1]["bytes_mean"] < rows[0]["bytes_mean"]
    assert "runs" not in rows[0]
    assert len(capsys.readouterr().out.splitlines()) == 5
    assert plot.stat().st_size > 1000


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--segment-steps", "0"), "at least 1 step"),
        (("--length-m", "nan"), "at least 1 m long"),
        (("--obstacles", "-1"), "cannot be negative"),
        (("--length-m", "1", "--obstacles", "1"), "at least 21 steps"),
    ],
)
def test_bad_options_are_refused_with_a_reason(options, reason, capsys) -> None:
    assert main(["route", *options]) == 1
    assert reason in capsys.readouterr().err
