"""What attractors, embedding and DAgger are each worth, on the same episodes (paper, Sec. IV-B)."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from cbe_bench.evaluation import RunConfig
from cbe_bench.memory import Memory
from cbe_bench.single import run
from cbe_bench.tally import compare
from cbe_runtime.networks import Networks

CLONED = "without DAgger"
PARTS = (Memory.FULL, Memory.NO_ATTRACTORS, Memory.NO_EMBEDDING)  # a single behavior has no joint
_PAIRED = ("pairs", "difference")


def ablate(config: RunConfig, cloned: Path | None = None) -> dict[str, Any]:
    """Drive the same episodes with the whole memory and with a part of it missing.

    Args:
        config: of the run with the full memory.
        cloned: folder of a model trained without DAgger, run as well, with the full memory.

    Returns:
        What `--json` holds: `rows`, the full memory's first, each a summary without its single
        episodes. The others hold what they gain over the full memory, paired: `difference`,
        `difference_ci95` and `pairs`.

    Raises:
        CbeError: a model, the world or an option cannot be used.
    """
    variants = {memory.value: replace(config, memory=memory) for memory in PARTS}
    if cloned is not None:
        Networks.load(cloned)  # refused now rather than after all the others
        variants[CLONED] = replace(config, model=cloned)
    summaries = {name: run(variant, name).summary for name, variant in variants.items()}
    full = summaries[Memory.FULL]
    rows = []
    for name, summary in summaries.items():
        row = {"name": name} | {key: value for key, value in summary.items() if key != "runs"}
        if summary is not full:
            paired = compare(full, summary)
            row |= {key: paired[key] for key in _PAIRED} | {"difference_ci95": paired["ci95"]}
        rows.append(row)
    return {"rows": rows, "model_id": full["model_id"]}


def table(result: Mapping[str, Any]) -> str:
    """The result as lines of text; intervals are of 95 %."""
    head = f"{'':20}{'success':>9}{'interval':>16}{'false arrivals':>16}"
    lines = [f"{head}{'points gained':>15}{'interval':>17}"]
    for row in result["rows"]:
        line = f"{row['name']:20}{100.0 * row['success']:8.1f}%{_interval(row['ci95']):>16}"
        line += f"{row['outcomes']['false_arrival']:16}"
        if "difference" in row:
            line += f"{100.0 * row['difference']:+15.1f}{_interval(row['difference_ci95']):>17}"
        lines.append(line)
    return "\n".join(lines)


def _interval(ends: tuple[float, float]) -> str:
    low, high = (100.0 * end for end in ends)
    return f"{low:.1f} to {high:.1f}"
