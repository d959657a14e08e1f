"""Pictures of a repeated drive: from above, through the camera, and its progress over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cbe_bench.demo_course import doorways

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from cbe_hil_sim.world import World

MARGIN_M, BIN_M = 2.0, 0.3
FLOOR, FURNITURE, WALL, DOORWAY = (252, 251, 248), (205, 184, 152), (68, 70, 78), (226, 236, 226)
TAUGHT, REPEATED, ATTRACTOR, OBSTACLE = "#3465a4", "#d9480f", "#2b8a3e", "#111111"


def overview(
    path: Path,
    world: World,
    demonstration: NDArray[np.floating],
    repetition: NDArray[np.floating],
    joints_m: NDArray[np.floating],
    bin_pose: tuple[float, float, float] | None,
    title: str,
) -> None:
    """Write the view from above.

    Args:
        path: the picture's file.
        world: walls, furniture and doorways.
        demonstration: true poses (T, 3) of the taught drive.
        repetition: true poses (N, 3) of the repeated one.
        joints_m: where the attractors were taken, (K, 2).
        bin_pose: centre and heading of the bin, where there is one.
        title: written above.
    """
    x0, y0 = world.origin_m
    width, height = world.size_m
    drawn = np.concatenate([demonstration[:, :2], repetition[:, :2]])
    low = np.maximum(drawn.min(axis=0) - MARGIN_M, (x0, y0))
    high = np.minimum(drawn.max(axis=0) + MARGIN_M, (x0 + width, y0 + height))
    shape = (high[1] - low[1]) / (high[0] - low[0])
    tall = min(max(float(shape), 0.4), 1.4)
    figure = Figure(figsize=(9.0, 9.0 * tall + 0.7), layout="constrained")
    axes = figure.subplots()
    axes.imshow(_plan(world), origin="lower", extent=(x0, x0 + width, y0, y0 + height))
    axes.plot(*demonstration[:, :2].T, color=TAUGHT, lw=2.5, alpha=0.8, label="demonstration")
    axes.plot(*repetition[:, :2].T, color=REPEATED, lw=1.6, label="repetition")
    axes.plot(*joints_m.T, "D", color=ATTRACTOR, ms=6, label="attractors", zorder=4)
    _arrow(axes, demonstration[0], TAUGHT)
    if len(repetition):
        _arrow(axes, repetition[0], REPEATED)
        axes.plot(*repetition[-1, :2], "o", color=REPEATED, ms=7, zorder=5)
    axes.plot(*demonstration[-1, :2], "*", color=TAUGHT, ms=14, zorder=4, label="goal")
    if bin_pose is not None:
        axes.add_patch(_square(bin_pose))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x (m)", ylabel="y (m)")
    axes.set_title(title)
    axes.legend(loc="best", fontsize=8, framealpha=0.9)
    figure.savefig(path, dpi=110)


def _plan(world: World) -> NDArray[np.uint8]:
    """Floor plan (rows, columns, 3) uint8 RGB, row 0 at the least y."""
    image = np.full((*world.solid_top_m.shape, 3), FLOOR, np.uint8)
    image[doorways(world) > 0] = DOORWAY
    image[world.blocked] = FURNITURE
    image[world.solid_top_m >= min(world.ceiling_m - 0.1, 2.1)] = WALL
    return image


def _square(pose: tuple[float, float, float]) -> Rectangle:
    x, y, yaw = pose
    corner = (x - 0.5 * BIN_M, y - 0.5 * BIN_M)
    return Rectangle(
        corner, BIN_M, BIN_M, angle=float(np.degrees(yaw)), rotation_point="center",
        color=OBSTACLE, zorder=3, label="bin",
    )  # fmt: skip


def _arrow(axes: Axes, pose: NDArray[np.floating], color: str) -> None:
    x, y, yaw = map(float, pose)
    tip = (x + 0.45 * np.cos(yaw), y + 0.45 * np.sin(yaw))
    axes.annotate("", tip, (x, y), arrowprops={"arrowstyle": "-|>", "color": color, "lw": 2})


def filmstrip(
    path: Path,
    taught: Sequence[NDArray[np.uint8]],
    repeated: Sequence[NDArray[np.uint8]],
    progress: Sequence[float],
) -> None:
    """Write camera frames of both drives in two rows, one column for each progress in 0 to 1."""
    columns = max(len(progress), 1)
    figure = Figure(figsize=(1.9 * columns, 3.4), layout="constrained")
    grid = figure.subplots(2, columns, squeeze=False)
    rows = (("demonstration", taught), ("repetition", repeated))
    for row, (name, frames) in zip(grid, rows, strict=True):
        for axes in row:
            axes.set(xticks=[], yticks=[])
        for axes, frame, done in zip(row, frames, progress, strict=True):
            axes.imshow(frame)
            axes.set_xlabel(f"{100.0 * done:.0f} %", fontsize=8)
        row[0].set_ylabel(name, fontsize=9)
    figure.savefig(path, dpi=100)


def progress(
    path: Path,
    time_s: NDArray[np.floating],
    believed: NDArray[np.floating],
    true: NDArray[np.floating],
    off_m: NDArray[np.floating],
    joints: NDArray[np.floating],
) -> None:
    """Write progress (N,) over time (N,), believed and true, and the distance off the drive (N,).

    `joints` are the shares of the drive, 0 to 1, at which one behavior hands over to the next.
    """
    figure = Figure(figsize=(8.0, 5.5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for joint in joints:
        upper.axhline(float(joint), color="0.8", lw=0.8)
    upper.plot(time_s, true, color=TAUGHT, lw=2.0, label="true, by distance")
    upper.plot(time_s, believed, color=REPEATED, lw=1.3, label="believed by the networks")
    upper.set(ylabel="progress along the drive", ylim=(-0.03, 1.08))
    upper.legend(loc="lower right", fontsize=8)
    lower.plot(time_s, off_m, color="0.3", lw=1.3)
    lower.set(ylabel="off the drive (m)", xlabel="time (s)", ylim=(0.0, None))
    figure.savefig(path, dpi=110)
