"""Where a run's progress is written: log.csv, curve.png and TensorBoard scalars."""

import csv
from pathlib import Path

LOSSES = (
    "waypoint", "progress", "on_route", "motion", "displacement", "shape", "relation", "views",
    "view_motion",
)  # fmt: skip
STEPS = (64, 128)
OUTCOMES = tuple(f"{name}_{s}" for s in STEPS for name in ("success", "collided", "false_arrival"))
FIELDS = (
    "iteration", "hours", "sequences", *LOSSES, "norm", "frames", "gap", "expert_share",
    "collided", "rollout_s", "update_s", *OUTCOMES,
)  # fmt: skip


class Curve:
    """Appends a row an iteration; a resumed run appends to what is there."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._writer: SummaryWriter = SummaryWriter(str(folder / "tensorboard"))

    def add(self, row: dict[str, float]) -> None:
        """Write one iteration's values, named as in FIELDS; missing ones stay empty."""
        path = self._folder / "log.csv"
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, FIELDS, restval="")
            if new:
                writer.writeheader()
            writer.writerow({k: round(v, 5) for k, v in row.items()})
        for name, value in row.items():
            self._writer.add_scalar(name, value, int(row["iteration"]))

    def draw(self) -> None:
        """Draw the whole log as curve.png."""
        draw(self._folder / "log.csv", self._folder / "curve.png")


def draw(log: Path, picture: Path) -> None:
    """Plot losses and validation success of a log.csv against hours."""
    import matplotlib.pyplot as plt

    with log.open() as file:
        rows = list(csv.DictReader(file))
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    for name in ("waypoint", "progress", "motion", "displacement", "shape", "views"):
        points = [(float(r["hours"]), float(r[name])) for r in rows if r[name]]
        smooth, kept = [], None
        for hours, value in points:
            kept = value if kept is None else 0.9 * kept + 0.1 * value
            smooth.append((hours, kept))
        left.plot(*zip(*smooth, strict=True), label=name)
    left.set(xlabel="hours", ylabel="loss (moving average)", yscale="log")
    for name in OUTCOMES:
        points = [(float(r["hours"]), 100.0 * float(r[name])) for r in rows if r[name]]
        if points:
            style = "-o" if name.startswith("success") else ":"
            label = name.replace("_", " ") + " steps"
            right.plot(*zip(*points, strict=True), style, markersize=3, label=label)
    right.set(xlabel="hours", ylabel="validation episodes (%)", ylim=(0, 100))
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(picture, dpi=110)
    plt.close(figure)
