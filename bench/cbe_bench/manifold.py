"""The manifold of behaviors: embeddings mapped, and what they tell linearly (paper, Sec. IV-B)."""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe import geometry
from cbe.errors import ConfigError, ModelError
from cbe_bench.drives import Pieces
from cbe_bench.episode import film
from cbe_bench.evaluation import use_one_thread
from cbe_bench.place import GENERATED, Place, world_seeds
from cbe_bench.scenario import GROUP, Terms, scenarios
from cbe_bench.single import teach
from cbe_runtime.networks import PACKAGED_MODELS, Networks

FEWEST = 40  # 33 numbers are fitted, and a t-SNE needs neighbours
HELD_OUT = 0.3  # share of the worlds that the linear reading is tested in
RIDGE = np.logspace(-4.0, 3.0, 15)
PERPLEXITY = 30.0
EXAMPLES, EXAMPLE = 12, "black"
EXAMPLE_SHARE = 0.13  # farthest reach of an example, as a share of the map


@dataclass(frozen=True, slots=True)
class ManifoldConfig:
    """What `cbe-bench manifold` embeds: demonstrations of `steps` steps of 0.1 s."""

    world: str = "test"
    steps: int = 100
    episodes: int = 1000
    seed: int = 0
    model: Path = PACKAGED_MODELS
    jobs: int = 0  # 0 takes a process a core

    def __post_init__(self) -> None:
        """Refuse what cannot be embedded."""
        if self.world not in GENERATED:
            raise ConfigError(
                f"{self.world!r} is no split: a map needs many worlds; give "
                f"{' or '.join(GENERATED)}"
            )
        if self.episodes < FEWEST or self.steps < 1 or self.seed < 0 or self.jobs < 0:
            raise ConfigError(
                f"at least {FEWEST} episodes of at least 1 step and a seed and jobs of 0 or more "
                f"are needed; found {self.episodes}, {self.steps}, {self.seed} and {self.jobs}"
            )

    @property
    def terms(self) -> Terms:
        """What is asked of the drives: they are only looked at, so nothing stands beside them."""
        return Terms(self.world, Pieces(self.steps), self.seed, jitter_scale=0.0)


@dataclass(frozen=True, slots=True)
class Behaviors:
    """Embedded demonstrations.

    `embedding` (N, 32) float32 as routes store it; `drives` (N, steps + 1, 3) poses in the frame
    of each drive's first; `world` (N,) the seed of the world that each took place in.
    """

    embedding: NDArray[np.float32]
    drives: NDArray[np.float64]
    world: NDArray[np.int64]
    model_id: str

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Last pose in the frame of the first: x and y in m, heading in rad, (N, 3)."""
        last: NDArray[np.float64] = self.drives[:, -1]
        return last


def embed(config: ManifoldConfig) -> Behaviors:
    """Make the demonstrations and let the runtime embed them, with a progress bar on stderr.

    Raises:
        ModelError: the model cannot be used, or embeds everything alike.
        WorldError: a world yields no drive of that length.
    """
    from joblib import Parallel, delayed
    from tqdm import tqdm

    model_id = Networks.load(config.model).model_id  # refused here rather than in every process
    groups = math.ceil(config.episodes / GROUP)
    jobs = min(config.jobs or os.cpu_count() or 1, groups)
    tasks = (
        delayed(_embed_group)(config, g, min(GROUP, config.episodes - g * GROUP))
        for g in range(groups)
    )
    parts: list[Behaviors] = []
    with tqdm(total=config.episodes, desc="demonstrations", unit="ep") as bar:
        for part in Parallel(n_jobs=jobs, return_as="generator")(tasks):
            parts.append(part)
            bar.update(len(part.world))
    behaviors = Behaviors(
        np.concatenate([part.embedding for part in parts]),
        np.concatenate([part.drives for part in parts]),
        np.concatenate([part.world for part in parts]),
        model_id,
    )
    if not np.ptp(behaviors.embedding, axis=0).any():
        raise ModelError(
            f"model {model_id} embeds all {config.episodes} drives alike; train it further"
        )
    return behaviors


def _embed_group(config: ManifoldConfig, group: int, count: int) -> Behaviors:
    """One process's task: the first `count` demonstrations of a group."""
    use_one_thread()
    networks = Networks.load(config.model)
    seeds = world_seeds(config.world, None)
    open_: Callable[[int], Place] = partial(Place, config.world)
    embeddings, drives, worlds = [], [], []
    for place, scenario in scenarios(config.terms, group, count, seeds, open_):
        poses = scenario.demonstration
        with place.backend() as (backend, see):
            embeddings.append(teach(networks, film(backend, see, poses)).embedding(0))
        drives.append(geometry.relative(poses[0], poses))
        worlds.append(scenario.world_seed)
    return Behaviors(
        np.array(embeddings), np.array(drives), np.array(worlds, np.int64), networks.model_id
    )


def read_off(behaviors: Behaviors, seed: int) -> dict[str, Any]:
    """How well ridge regression reads the displacement off the embedding, in unseen worlds.

    The heading is read as the angle of a cosine and a sine, since it has no end. R2 and the
    median absolute error of each component are of the held-out worlds; `median_error_blind` is
    the error of always answering the other worlds' mean.

    Raises:
        ConfigError: the drives are all of one world.
    """
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    held = _held_out(behaviors.world, seed)
    x, y, heading_rad = behaviors.displacement.T
    target = np.stack([x, y, np.cos(heading_rad), np.sin(heading_rad)], axis=1)  # (N, 4)
    model = make_pipeline(StandardScaler(), RidgeCV(RIDGE))
    model.fit(behaviors.embedding[~held], target[~held])
    true = behaviors.displacement[held]
    read = _error(model.predict(behaviors.embedding[held]), true)
    blind = _error(np.broadcast_to(target[~held].mean(axis=0), (len(true), 4)), true)
    # Of the held-out drives' own mean, as R2 has it.
    spread = _error(np.broadcast_to(target[held].mean(axis=0), (len(true), 4)), true)
    r2 = 1.0 - (read**2).sum(axis=0) / (spread**2).sum(axis=0)
    components = (("x", "m"), ("y", "m"), ("heading", "deg"))
    return {"train": int((~held).sum()), "test": int(held.sum())} | {
        name: {
            "r2": float(r2[i]),
            f"median_error_{unit}": float(np.median(np.abs(read[:, i]))),
            f"median_error_blind_{unit}": float(np.median(np.abs(blind[:, i]))),
        }
        for i, (name, unit) in enumerate(components)
    }


def _held_out(world: NDArray[np.int64], seed: int) -> NDArray[np.bool_]:
    """Which drives (N,) are kept for the test: whole worlds, so that none is known already."""
    worlds = np.random.default_rng(seed).permutation(np.unique(world))
    if len(worlds) < 2:
        raise ConfigError(f"drives of at least 2 worlds are needed, found {len(worlds)}")
    return np.isin(world, worlds[: max(1, round(HELD_OUT * len(worlds)))])


def _error(read: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors in m, m and deg (N, 3) of x, y, cosine and sine (N, 4) against x, y, heading."""
    turned = geometry.wrap_angle(np.arctan2(read[:, 3], read[:, 2]) - true[:, 2])
    return np.column_stack([read[:, :2] - true[:, :2], np.degrees(turned)])


def spread_out(behaviors: Behaviors, seed: int) -> NDArray[np.float64]:
    """The t-SNE map (N, 2) of the embeddings, the same for the same seed."""
    from sklearn.manifold import TSNE

    perplexity = min(PERPLEXITY, (len(behaviors.world) - 1) / 3.0)
    tsne = TSNE(perplexity=perplexity, init="pca", random_state=seed)
    return np.asarray(tsne.fit_transform(behaviors.embedding), np.float64)


def measure(config: ManifoldConfig, plot: Path | None = None) -> dict[str, Any]:
    """What `--json` holds; draws the map to `plot` where one is named.

    Raises:
        CbeError: as `embed`.
    """
    behaviors = embed(config)
    shown = {key: value for key, value in asdict(config).items() if key not in {"model", "jobs"}}
    result = {
        "readout": read_off(behaviors, config.seed),
        "config": shown,
        "model_id": behaviors.model_id,
    }
    if plot is not None:
        draw(behaviors, spread_out(behaviors, config.seed), plot, result)
    return result


def table(result: Mapping[str, Any]) -> str:
    """The linear reading as lines of text."""
    readout = result["readout"]
    lines = [f"{'':9}{'R2':>7}{'median error':>16}{'knowing nothing':>18}"]
    for name, unit in (("x", "m"), ("y", "m"), ("heading", "deg")):
        row = readout[name]
        error, blind = row[f"median_error_{unit}"], row[f"median_error_blind_{unit}"]
        lines.append(
            f"{name:9}{row['r2']:7.3f}{f'{error:.2f} {unit}':>16}{f'{blind:.2f} {unit}':>18}"
        )
    lines.append(
        f"fitted to {readout['train']} drives, tested on {readout['test']} in other worlds"
    )
    return "\n".join(lines)


def draw(
    behaviors: Behaviors, points: NDArray[np.float64], path: Path, result: Mapping[str, Any]
) -> None:
    """Write the map, points (N, 2) coloured by where their drives lead, with some drives drawn.

    Those begin at their points, setting out to the right, all to one scale.
    """
    from matplotlib.figure import Figure
    from matplotlib.patheffects import Normal, Stroke

    x, y, _ = behaviors.displacement.T
    width, height = np.ptp(points, axis=0)
    tall = min(max(float(height / max(width, 1e-9)), 0.4), 1.2)
    figure = Figure(figsize=(9.0, 7.8 * tall + 0.9), layout="constrained")
    axes = figure.subplots()
    direction_deg = np.degrees(np.arctan2(y, x))
    dots = axes.scatter(
        points[:, 0], points[:, 1], c=direction_deg, s=22, cmap="hsv", vmin=-180, vmax=180, lw=0
    )
    bar = figure.colorbar(dots, ticks=[-180, -90, 0, 90, 180], fraction=0.04, pad=0.01)
    bar.set_label("direction of the displacement (deg, left is positive)")
    halo = [Stroke(linewidth=5.0, foreground="white"), Normal()]
    chosen = _examples(points)
    reach_m = float(np.abs(behaviors.drives[chosen, :, :2]).max())
    scale = EXAMPLE_SHARE * float(max(width, height)) / max(reach_m, 1e-9)
    for i in chosen:
        line = points[i] + scale * behaviors.drives[i, :, :2]  # (T, 2)
        axes.plot(*line.T, color=EXAMPLE, lw=2.0, path_effects=halo)
        axes.plot(*points[i], "o", color=EXAMPLE, mec="white", ms=7)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_xlabel(f"t-SNE of the embeddings; {len(chosen)} drives from their points on, in black")
    config, readout = result["config"], result["readout"]
    axes.set_title(
        f"{config['episodes']} drives of {config['steps']} steps, {config['world']} worlds, model "
        f"{behaviors.model_id}\nread off linearly: "
        + ", ".join(f"{name} R² {readout[name]['r2']:.2f}" for name in ("x", "y", "heading")),
        fontsize=10,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _examples(points: NDArray[np.float64]) -> list[int]:
    """Points (N, 2) far from one another: each the farthest from those before it."""
    nearest = np.hypot(*(points - points.mean(axis=0)).T)
    chosen = [int(nearest.argmax())]
    for _ in range(min(EXAMPLES, len(points)) - 1):
        nearest = np.minimum(nearest, np.hypot(*(points - points[chosen[-1]]).T))
        chosen.append(int(nearest.argmax()))
    return chosen
