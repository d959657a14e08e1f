"""All figures of the model card, one run after the other; what is done is not done again."""

import json
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cbe_runtime.networks import Networks

SCENES = ("aws_small_house", "pal_office", "aws_small_warehouse")


@dataclass(frozen=True, slots=True)
class Line:
    """One run: a command of `cbe-bench`, and how many episodes it has."""

    name: str
    command: str
    episodes: int

    def of(self, share: float) -> "Line":
        """The same with a share of the episodes."""
        return replace(self, episodes=max(round(share * self.episodes), 1))

    @property
    def arguments(self) -> list[str]:
        """What to call `cbe-bench` with."""
        return [*shlex.split(self.command), "--episodes", str(self.episodes)]


LINES = (
    Line("single-64", "single --steps 64", 2000),
    Line("single-128", "single --steps 128", 2000),
    Line("single-192", "single --steps 192", 2000),
    Line("single-256", "single --steps 256", 2000),
    Line("single-joint", "single --steps 100 --jitter-scale 0.4", 2000),
    Line("single-noise-0.5", "single --steps 128 --noise 0.5", 2000),
    Line("single-noise-1.0", "single --steps 128 --noise 1.0", 2000),
    *(
        Line(f"single-bin-{metres}", f"single --steps 128 --obstacle-offset {metres}", 1000)
        for metres in ("0.0", "0.075", "0.15", "0.225")
    ),
    Line("single-u4", "single --steps 128 --precision u4", 2000),
    Line("single-bullet", "single --steps 128 --backend bullet", 200),
    Line("single-narrow", "single --steps 128 --camera 70x55", 2000),
    Line("route-20", "route --length-m 20 --precision u4", 500),
    Line("route-20-hairpins", "route --length-m 20 --precision u4 --hairpins", 500),
    Line("route-20-f32", "route --length-m 20 --precision f32", 500),
    Line("route-20-blind-joints", "route --length-m 20 --precision u4 --no-relocation", 200),
    Line("route-100", "route --length-m 100 --precision u4", 100),
    Line("join", "join --precision u4", 500),
    Line("kidnap", "kidnap --precision u4", 1000),
    Line("lint", "lint", 200),
)


def lines(scenes: Path | None) -> tuple[Line, ...]:
    """All runs; those in mesh scenes where their folder is given."""
    if scenes is None:
        return LINES
    found = list(LINES)
    for name in SCENES:
        where = f"--world {shlex.quote(str(scenes / name))} --backend bullet"
        found.append(Line(f"single-{name}", f"single --steps 128 {where}", 100))
        found.append(Line(f"route-{name}", f"route --length-m 20 --precision u4 {where}", 50))
    return tuple(found)


def run(
    chosen: Sequence[Line],
    folder: Path,
    model: Path,
    call: Callable[[list[str]], None],
    note: Callable[[str], None],
) -> list[tuple[Line, dict[str, Any]]]:
    """Run what `folder` does not hold of this model and so many episodes; gives every result.

    `call` is `cbe-bench` itself.

    Raises:
        CbeError: a run could not be made.
    """
    model_id = Networks.load(model).model_id
    done = []
    for line in chosen:
        path = folder / f"{line.name}.json"
        result = _read(path)
        if (result.get("model_id"), result.get("episodes")) != (model_id, line.episodes):
            arguments = [*line.arguments, "--model", str(model), "--json", str(path)]
            note(f"cbe-bench {shlex.join(arguments)}")
            call(arguments)
            result = _read(path)
        done.append((line, result))
    return done


def table(done: Sequence[tuple[Line, dict[str, Any]]]) -> str:
    """The results as a table in Markdown, a row for each run."""
    rows = ["| `cbe-bench` | episodes | result | 95 % interval | beside it |", "|" + "---|" * 5]
    for line, result in done:
        share, aside = _told(result)
        low, high = (100.0 * end for end in result["ci95"])
        interval = f"{low:.1f} to {high:.1f} %"
        rows.append(f"| `{line.command}` | {result['episodes']} | {share} | {interval} | {aside} |")
    return "\n".join(rows)


def _told(result: dict[str, Any]) -> tuple[str, str]:
    """What was measured, and what else is worth saying."""
    if "lost_within_5s" in result:
        told = f"LOST within 5 s {100.0 * result['lost_within_5s']:.1f} %"
        return told, f"false ARRIVED {100.0 * result['false_arrived']:.2f} %"
    if "flagged" in result:
        return f"passed less flagged {100.0 * result['difference']:+.1f} points", ""
    kinds = {name: count for name, count in result["outcomes"].items() if name != "arrived"}
    aside = ", ".join(f"{name} {count}" for name, count in kinds.items() if count)
    if "bytes_mean" in result:
        aside = f"{result['bytes_mean']:.0f} bytes; {aside or 'no failure'}"
    return f"{100.0 * result['success']:.1f} %", aside or "no failure"


def _read(path: Path) -> dict[str, Any]:
    """A result, empty where there is none."""
    try:
        result = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return result if isinstance(result, dict) else {}
