"""Success against compression ratio, the paper's figure, and against bytes (Sec. IV-C)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cbe_bench import route
from cbe_bench.route import RouteConfig, Teaching, precision_of
from cbe_runtime.route import AttractorPrecision

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SEGMENT_STEPS = (32, 50, 75, 100, 150, 250)
PAPER = {"CBE": (19, 97.2), "SLAM, 1024 x 1024": (341, 96.3), "SLC": (1548, 93.7)}
"""Kilobytes a route and success in per cent, from the paper's table of memory efficiency."""

COLOURS = {"f32": "#3465a4", "u8": "#2b8a3e", "u4": "#d9480f"}


def measure(
    config: RouteConfig,
    segment_steps: Sequence[int],
    precisions: Sequence[AttractorPrecision],
) -> dict[str, Any]:
    """Drive the same episodes with each length of segments in each precision.

    Returns:
        What `--json` holds: `rows`, each a summary of `cbe-bench route` without its single
        episodes, under `segment_steps` and `precision`.

    Raises:
        CbeError: the model, the world or an option cannot be used.
    """
    variants = [
        replace(config, teaching=Teaching(steps, precision_of(precision), config.teaching.adaptive))
        for precision in precisions
        for steps in segment_steps
    ]
    rows = []
    for variant in variants:
        named = {
            "segment_steps": variant.teaching.segment_steps,
            "precision": variant.teaching.precision.attractor.value,
        }
        done = route.run(variant, "K {segment_steps}, {precision}".format(**named)).summary
        rows.append(named | {key: value for key, value in done.items() if key != "runs"})
    return {"rows": rows, "model_id": rows[0]["model_id"]}


def table(result: Mapping[str, Any]) -> str:
    """The result as lines of text; intervals are of 95 %."""
    lines = [f"{'K':>5}{'precision':>11}{'success':>10}{'interval':>16}{'ratio':>8}{'bytes':>8}"]
    for row in result["rows"]:
        low, high = (100.0 * end for end in row["ci95"])
        lines.append(
            f"{row['segment_steps']:5}{row['precision']:>11}{100.0 * row['success']:9.1f}%"
            f"{f'{low:.1f} to {high:.1f}':>16}{row['compression_ratio']:8.1f}"
            f"{row['bytes_mean']:8.0f}"
        )
    return "\n".join(lines)


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Plot success, a line a precision, against compression ratio and against bytes."""
    from matplotlib.figure import Figure

    rows = result["rows"]
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    ratio, size = figure.subplots(1, 2, sharey=True)
    for precision in dict.fromkeys(row["precision"] for row in rows):
        line = [row for row in rows if row["precision"] == precision]
        _draw_line(ratio, line, [row["compression_ratio"] for row in line], precision)
        _draw_line(size, line, [row["bytes_mean"] for row in line], precision)
    ratio.axhline(PAPER["CBE"][1], color="#555555", ls=":", lw=1, label="paper's CBE")
    ratio.set_xlabel("compression ratio: observations a behavior")
    ratio.set_ylabel("success (%)")
    ratio.legend(loc="lower left", fontsize=8)
    for name, (kilobytes, percent) in PAPER.items():
        size.plot(1000.0 * kilobytes, percent, "k*", ms=7)
        size.annotate(
            f"paper's {name}", (1000.0 * kilobytes, percent), xytext=(0, -12),
            textcoords="offset points", ha="center", fontsize=7,
        )  # fmt: skip
    size.set_xscale("log")
    size.set_xlabel("bytes a route, the whole file")
    size.margins(x=0.12)
    for axes in (ratio, size):
        axes.set_ylim(top=102)
        axes.grid(alpha=0.3)
    first = rows[0]
    figure.suptitle(
        f"model {result['model_id']}, {first['episodes']} routes of {first['length_mean_m']:.0f} m "
        "each; bars are 95 % intervals",
        fontsize=9,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _draw_line(
    axes: "Axes", line: Sequence[Mapping[str, Any]], x: Sequence[float], precision: str
) -> None:
    percent = [100.0 * row["success"] for row in line]
    ends = [[100.0 * abs(row["ci95"][end] - row["success"]) for row in line] for end in (0, 1)]
    axes.errorbar(x, percent, ends, fmt="o-", color=COLOURS[precision], capsize=3, label=precision)
