"""Routes taught well and badly: do those that the lint passes succeed more often?"""

import functools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cbe_bench.episode import Outcome, film, ride
from cbe_bench.evaluation import RunConfig, Stage, each_episode
from cbe_bench.route import Teaching
from cbe_bench.tally import independent_difference, wilson
from cbe_runtime import routefile
from cbe_runtime.follower import Follower
from cbe_runtime.forecast import judge
from cbe_runtime.lint import look_over
from cbe_runtime.networks import Networks
from cbe_runtime.perturb import blurred

LONG_STEPS = 240
DIM_GAIN, DIM_NOISE_LEVELS = 0.12, 6.0
SOFT_PASSES = 6
COVERED_SHARE = 0.6  # of the view's columns
SLOW_STEPS = 10  # a frame a second
COVER_LEVEL = 12


class Quality(StrEnum):
    """How a drive was recorded and cut."""

    GOOD = "as filmed"
    LONG = "segments too long"
    DIM = "hardly lit"
    SOFT = "out of focus"
    COVERED = "lens half covered"
    SLOW = "a frame a second"

    def spoilt(
        self, views: Sequence[NDArray[np.uint8]], rng: np.random.Generator
    ) -> list[NDArray[np.uint8]]:
        """The views (64, 64, 3) of a drive as such a recording holds them."""
        match self:
            case Quality.DIM:
                return [_dim(view, rng) for view in views]
            case Quality.SOFT:
                return [_soft(view) for view in views]
            case Quality.COVERED:
                return [_covered(view) for view in views]
            case Quality.SLOW:
                return [views[step - step % SLOW_STEPS] for step in range(len(views))]
            case _:
                return list(views)


@dataclass(frozen=True, slots=True)
class LintConfig:
    """A run of `cbe-bench lint`."""

    run: RunConfig
    teaching: Teaching = field(default_factory=Teaching)


@dataclass(frozen=True, slots=True)
class Linted:
    """One episode; `verdict` as `cbe-route lint --json` writes it."""

    index: int
    quality: Quality
    passed: bool
    predicted_success: float
    outcome: Outcome
    verdict: dict[str, Any]

    @property
    def success(self) -> bool:
        """Arrived, and truly."""
        return self.outcome is Outcome.ARRIVED


def measure(config: LintConfig) -> dict[str, Any]:
    """Teach, lint and drive all, in equal shares of each quality; what `--json` holds.

    `difference` is the success of the routes passed less that of those flagged.

    Raises:
        CbeError: the model, the world or an option cannot be used.
    """
    model_id = Networks.load(config.run.model).model_id
    episodes = each_episode(config.run, functools.partial(_drive, config), "routes", _rate)
    passed = [each.success for each in episodes if each.passed]
    flagged = [each.success for each in episodes if not each.passed]
    difference = independent_difference(sum(passed), len(passed), sum(flagged), len(flagged))
    return {
        "episodes": len(episodes),
        "passed": _tally([each for each in episodes if each.passed]),
        "flagged": _tally([each for each in episodes if not each.passed]),
        "difference": difference[0],
        "ci95": difference[1:],
        "qualities": {
            kind.value: _tally([each for each in episodes if each.quality is kind])
            for kind in Quality
        },
        "config": config.run.to_dict() | config.teaching.to_dict(),
        "model_id": model_id,
        "runs": [asdict(each) | {"success": each.success} for each in episodes],
    }


def table(result: dict[str, Any]) -> str:
    """The result as lines of text."""
    lines = [f"{'':20} routes  success  predicted  passed"]
    rows = {key: result[key] for key in ("passed", "flagged")} | result["qualities"]
    for name, row in rows.items():
        if row["routes"]:
            lines.append(
                f"{name:20} {row['routes']:6d}  {100.0 * row['success']:5.1f} %"
                f"  {100.0 * row['predicted_success']:7.1f} %  {100.0 * row['passed']:5.1f} %"
            )
    low, high = result["ci95"]
    lines.append(
        f"passed less flagged: {100.0 * result['difference']:+.1f} points "
        f"({100.0 * low:+.1f} to {100.0 * high:+.1f})"
    )
    return "\n".join(lines)


def _rate(done: Sequence[Linted]) -> str:
    right = sum(each.success is each.passed for each in done)
    return f"foretold {right / len(done):.3f}"


def _tally(episodes: Sequence[Linted]) -> dict[str, Any]:
    count, successes = len(episodes), sum(each.success for each in episodes)
    if count == 0:
        return {"routes": 0}
    return {
        "routes": count,
        "success": successes / count,
        "ci95": list(wilson(successes, count)),
        "predicted_success": sum(each.predicted_success for each in episodes) / count,
        "passed": sum(each.passed for each in episodes) / count,
    }


def _drive(config: LintConfig, stage: Stage) -> Linted:
    """Teach from a recording of some quality, lint the route on it, repeat it well lit."""
    networks, scenario = stage.networks, stage.scenario
    quality = list(Quality)[scenario.index % len(Quality)]
    rng = np.random.default_rng([config.run.terms.seed, scenario.index, 5])
    with stage.place.backend() as (backend, see):
        views = quality.spoilt(film(backend, see, scenario.demonstration), rng)
    teaching = config.teaching
    if quality is Quality.LONG:
        teaching = replace(teaching, segment_steps=LONG_STEPS)
    route = routefile.parse(routefile.dump(teaching(networks, views)))
    verdict = judge(look_over(networks, route, views))
    assert verdict.predicted_success is not None  # the drive is known
    with stage.place.backend(noise=config.run.noise, rng=rng, bins=scenario.bins) as (backend, see):
        follower = Follower(networks, route)
        driven = ride(follower, backend, see, scenario.demonstration, scenario.start)
    return Linted(
        scenario.index, quality, verdict.passed, verdict.predicted_success, driven.outcome,
        verdict.to_dict(),
    )  # fmt: skip


def _dim(view: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    noise = DIM_NOISE_LEVELS * rng.standard_normal(view.shape)
    dim: NDArray[np.uint8] = np.clip(DIM_GAIN * view + noise, 0.0, 255.0).astype(np.uint8)
    return dim


def _soft(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
    for _ in range(SOFT_PASSES):
        view = blurred(view, 0)
    return view


def _covered(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
    covered = view.copy()
    covered[:, : round(COVERED_SHARE * view.shape[1])] = COVER_LEVEL
    return covered
