"""A sheet of traces seen from above, failures first, as in the paper's figures."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cbe_bench.episode import Outcome
from cbe_bench.evaluation import Trace
from cbe_bench.place import Place

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANELS, COLUMNS = 24, 6
MARGIN_M = 1.0
DEMONSTRATION, ARRIVED, FAILED, BIN = "#3465a4", "#2b8a3e", "#d9480f", "#111111"


def draw(traces: Sequence[Trace], world: str, path: Path, title: str) -> None:
    """Write a sheet of at most 24 traces of one run to `path`; half of it shows failures."""
    from matplotlib.figure import Figure

    chosen = _choose(traces)
    rows = math.ceil(len(chosen) / COLUMNS)
    figure = Figure(figsize=(2.6 * COLUMNS, 2.8 * rows + 0.5), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axes, trace in zip(panels, chosen, strict=False):
        _draw_one(axes, trace, world)
    for axes in panels[len(chosen) :]:
        axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _choose(traces: Sequence[Trace]) -> list[Trace]:
    failed = [trace for trace in traces if not trace.record.success]
    arrived = [trace for trace in traces if trace.record.success]
    failures = failed[: max(PANELS // 2, PANELS - len(arrived))]
    return failures + arrived[: PANELS - len(failures)]


def _draw_one(axes: "Axes", trace: Trace, name: str) -> None:
    from matplotlib.patches import Circle

    record = trace.record
    world = Place(name, record.world_seed).world
    x0, y0 = world.origin_m
    width, height = world.size_m
    axes.imshow(
        world.blocked, origin="lower", extent=(x0, x0 + width, y0, y0 + height),
        cmap="Greys", vmin=0.0, vmax=1.6, interpolation="nearest",
    )  # fmt: skip
    colour = ARRIVED if record.success else FAILED
    axes.plot(*trace.demonstration[:, :2].T, color=DEMONSTRATION, lw=2.5, alpha=0.7)
    axes.plot(*trace.demonstration[-1, :2], "*", color=DEMONSTRATION, ms=10)
    axes.plot(*trace.poses[:, :2].T, color=colour, lw=1.3)
    axes.plot(*trace.poses[0, :2], "o", color=colour, ms=4)
    for bin_ in trace.bins:
        axes.add_patch(Circle((bin_.x_m, bin_.y_m), bin_.radius_m, color=BIN))
    if record.outcome is not Outcome.ARRIVED:
        axes.plot(*trace.poses[-1, :2], "X", color=FAILED, ms=9, mec="white")
    drawn = np.concatenate([trace.demonstration[:, :2], trace.poses[:, :2]])
    middle = 0.5 * (drawn.min(axis=0) + drawn.max(axis=0))
    reach = 0.5 * float(np.ptp(drawn, axis=0).max()) + MARGIN_M
    axes.set_xlim(middle[0] - reach, middle[0] + reach)
    axes.set_ylim(middle[1] - reach, middle[1] + reach)
    axes.set_title(f"{record.index}: {record.outcome}, {record.final_error_m:.2f} m", fontsize=8)
    axes.set_xticks([])
    axes.set_yticks([])
