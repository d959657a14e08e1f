"""Success against the length of the drive, beside the paper's stated points (Sec. IV-B)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cbe_bench.drives import Pieces
from cbe_bench.evaluation import RunConfig
from cbe_bench.single import run

STEPS = (16, 32, 64, 96, 128, 160, 192, 256)
PAPER_SUCCESS, PAPER_STEPS = 0.95, 128  # "> 95 % for trajectories of up to 128 time steps"


def sweep(config: RunConfig, steps: Sequence[int]) -> dict[str, Any]:
    """Run each length; the summaries without their single episodes."""
    rows = []
    for length in steps:
        terms = replace(config.terms, drives=Pieces(length))
        single = run(replace(config, terms=terms), f"{length} steps")
        rows.append({"steps": length} | {k: v for k, v in single.summary.items() if k != "runs"})
    return {"lengths": rows, "model_id": rows[0]["model_id"]}


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Plot success with its confidence band, and the paper's measure, against the length."""
    from matplotlib.figure import Figure

    rows = result["lengths"]
    steps = [row["steps"] for row in rows]
    percent = {key: [100.0 * row[key] for row in rows] for key in ("success", "success_paper")}
    low, high = ([100.0 * row["ci95"][end] for row in rows] for end in (0, 1))
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.fill_between(steps, low, high, color="#3465a4", alpha=0.2, lw=0, label="95 % interval")
    axes.plot(steps, percent["success"], "o-", color="#3465a4", label="arrived, by itself")
    axes.plot(
        steps, percent["success_paper"], "s--", color="#2b8a3e", lw=1,
        label="ever within 0.54 m (the paper's measure)",
    )  # fmt: skip
    axes.hlines(
        100.0 * PAPER_SUCCESS, 0, PAPER_STEPS, color="#d9480f", ls=":",
        label="paper, oracle stop: above this up to 128",
    )  # fmt: skip
    axes.set_xlabel("length of the demonstration (steps of 0.1 s)")
    axes.set_ylabel("success (%)")
    axes.set_xticks(steps)
    axes.set_xlim(0, max(steps) + 8)
    axes.set_ylim(top=101)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left", fontsize=8)
    axes.set_title(f"model {result['model_id']}, {rows[0]['episodes']} episodes each", fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
