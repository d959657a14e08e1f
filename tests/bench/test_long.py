"""Long routes are carried by processes of their own; their files grow with their length alone."""

import json
import math

import pytest

from cbe.robot import STEP_S, Robot
from cbe_bench import long
from cbe_bench.cli import main
from cbe_runtime.networks import Networks


def test_file_grows_with_the_length_and_little_else(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(long, "FILMED_STEPS", 100)
    monkeypatch.setattr(long, "ROUNDS", 1)
    path = tmp_path / "long.json"
    assert main(["long", "--length-m", "400", "--precision", "u4", "--json", str(path)]) == 0
    short, far = json.loads(path.read_text())["lengths"]
    assert (short["length_m"], far["length_m"]) == (20.0, 400.0)
    longest = Networks.load().segment_steps
    steps = [round(length_m / STEP_S / Robot().max_speed_mps) for length_m in (20.0, 400.0)]
    assert [row["segments"] for row in (short, far)] == [math.ceil(n / longest) for n in steps]
    assert far["bytes"] < 20 * short["bytes"]
    assert far["teaching_mib"] < 5.0
    assert far["memory_mib"] - short["memory_mib"] < 5.0
    assert far["load_s"] < 1.0
    assert far["tick_ms"] < 3.0 * short["tick_ms"]
    assert "400 m" in capsys.readouterr().out


@pytest.mark.parametrize("lengths", ["0", "nan", "1000,-1"])
def test_lengths_that_are_none_are_refused(lengths, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["long", f"--length-m={lengths}"])
    assert "numbers above 0" in capsys.readouterr().err
