"""The model card's runs go on where they were, and are told in one table."""

import json

import pytest

from cbe_bench import card
from cbe_bench.card import Line
from cbe_bench.cli import main

pytestmark = pytest.mark.usefixtures("counting")

WORLD = "--world val --jobs 1"
FEW = (
    Line("single-short", f"single --steps 20 {WORLD}", 4),
    Line("route-short", f"route --length-m 5 {WORLD}", 2),
    Line("kidnap-short", f"kidnap --length-m 5 {WORLD}", 2),
)


@pytest.fixture
def few(monkeypatch, tmp_path):
    monkeypatch.setattr(card, "LINES", FEW)
    return ["card", "--folder", str(tmp_path), "--model", "."]


def test_every_run_is_told_in_a_row_of_its_own(few, tmp_path, capsys) -> None:
    assert main([*few, "--share", "0.5"]) == 0
    rows = [row for row in capsys.readouterr().out.splitlines() if row.startswith("| `")]
    assert [row.count("|") for row in rows[1:]] == [6, 6, 6]
    assert "| 2 |" in rows[1]
    assert "bytes" in rows[2]
    assert "LOST within 5 s" in rows[3]
    assert json.loads((tmp_path / "single-short.json").read_text())["episodes"] == 2


def test_what_is_done_is_not_done_again_unless_asked_otherwise(few, tmp_path, capsys) -> None:
    path = tmp_path / "single-short.json"
    assert main([*few, "--only", "single"]) == 0
    first = path.stat().st_mtime_ns
    assert main([*few, "--only", "single"]) == 0
    assert path.stat().st_mtime_ns == first
    assert main([*few, "--only", "single", "--share", "0.5"]) == 0
    assert json.loads(path.read_text())["episodes"] == 2
    path.write_text("{")
    assert main([*few, "--only", "single"]) == 0
    assert json.loads(path.read_text())["episodes"] == 4


def test_name_that_no_run_has_is_refused_with_those_there_are(few, capsys) -> None:
    assert main([*few, "--only", "sinlge"]) == 1
    assert "single-short, route-short, kidnap-short" in capsys.readouterr().err


def test_scenes_are_driven_where_their_folder_is_given(tmp_path) -> None:
    names = {line.name for line in card.lines(tmp_path)} - {line.name for line in card.LINES}
    assert names == {f"{kind}-{scene}" for kind in ("single", "route") for scene in card.SCENES}


def test_every_run_of_the_card_is_one_that_can_be_asked_for() -> None:
    from cbe_bench.cli import _parser

    for line in card.lines(None):
        assert _parser().parse_args(line.arguments).episodes == line.episodes
