"""Kidnapped robots are judged by when they say LOST and by whether an arrival was one."""

import json

import numpy as np
import pytest

from cbe.errors import WorldError
from cbe_bench import kidnap
from cbe_bench.cli import main
from cbe_bench.kidnap import FAR_M, IN_TIME_S, Kidnapping, Kind
from cbe_bench.place import Place

KEYS = {"episodes", "lost_within_5s", "false_arrived", "median_s", "ci95", "kinds", "curve"}


@pytest.fixture(autouse=True)
def shortly(monkeypatch):
    monkeypatch.setattr(kidnap, "WATCHED_S", 6.0)


def run(folder, episodes, *options):
    path = folder / "kidnap.json"
    fixed = ["--jobs", "1", "--world", "val", "--model", ".", "--json", str(path)]
    length = ["--length-m", "5", "--episodes", str(episodes)]
    assert main(["kidnap", *length, *fixed, *options]) == 0
    return json.loads(path.read_text())


def test_robot_that_never_doubts_is_never_lost_and_arrives_falsely(tmp_path, counting) -> None:
    result = run(tmp_path, 2)  # both kinds of wrong routes
    assert result.keys() >= KEYS
    assert result["lost_within_5s"] == 0.0
    assert result["median_s"] is None
    assert result["false_arrived"] == 1.0
    assert [result["kinds"][kind.value]["episodes"] for kind in Kind] == [1, 1, 0, 0]


def test_robot_that_doubts_all_along_is_lost_in_time(tmp_path, counting, capsys) -> None:
    counting.on_route = 0.01
    result = run(tmp_path, 2)
    assert result["lost_within_5s"] == 1.0
    assert 0.0 < result["median_s"] < IN_TIME_S
    assert result["false_arrived"] == 0.0
    assert "100.0 %" in capsys.readouterr().out


def test_curve_ends_at_the_threshold_in_use(tmp_path, counting) -> None:
    counting.on_route = 0.01
    curve = run(tmp_path, 3, "--stop", "0.99")["curve"]
    assert curve[-1]["stop"] == 0.99
    detected = [point["lost_within_5s"] for point in curve]
    assert detected == sorted(detected, reverse=True)
    assert curve[0]["false_alarms"] == 1.0  # it doubted before it was carried away, too


def test_lost_too_late_or_arrived_truly_is_told_apart() -> None:
    late = Kidnapping(0, Kind.CARRIED, IN_TIME_S + 0.1, None, False, False, 0.0, 0.0)
    assert not late.in_time
    assert not late.false_arrival
    assert not Kidnapping(0, Kind.CARRIED, None, 9.0, True, False, 0.0, 0.0).false_arrival


def test_places_to_be_carried_to_are_far_from_the_drive() -> None:
    place = Place("val", 90_000)
    rng = np.random.default_rng(0)
    drive = kidnap._elsewhere(place, None, rng)[None]
    for _ in range(5):
        pose = kidnap._elsewhere(place, drive, rng)
        assert np.hypot(*(pose - drive[0])[:2]) >= FAR_M
    rows, columns = place.world.clearance_m.shape
    x, y = place.world.origin_m
    size = place.world.resolution_m
    everywhere = np.stack(
        np.meshgrid(x + size * np.arange(0, columns, 10), y + size * np.arange(0, rows, 10)), -1
    ).reshape(-1, 2)
    with pytest.raises(WorldError, match="no place"):
        kidnap._elsewhere(place, np.pad(everywhere, ((0, 0), (0, 1))), rng)
