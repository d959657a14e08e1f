"""Episodes counted: rates with their intervals, and two runs compared episode by episode."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from cbe.errors import ConfigError
from cbe_bench.episode import Outcome

Z95 = 1.959963984540054
_SAME_GOAL_M = 0.01


@dataclass(frozen=True, slots=True)
class Record:
    """One episode's result; `goal` is the demonstration's last pose, naming the episode."""

    index: int
    world_seed: int
    goal: tuple[float, float, float]
    outcome: Outcome
    success: bool
    success_paper: bool
    spl: float
    final_error_m: float
    final_error_deg: float
    min_clearance_m: float
    steps: int


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a rate, as fractions; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, Z95**2
    middle = rate + z2 / (2 * trials)
    half = Z95 * math.sqrt(rate * (1.0 - rate) / trials + z2 / (4 * trials**2))
    scale = 1.0 + z2 / trials
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def paired_difference(only_a: int, only_b: int, pairs: int) -> tuple[float, float, float]:
    """Success rate of b less that of a, with its 95 % interval (Agresti and Min, 2005).

    `only_a` and `only_b` count the pairs in which one alone succeeded.
    """
    if pairs == 0:
        return 0.0, -1.0, 1.0
    # Half a pair added to each of the four cells keeps the interval honest for few discordant.
    a, b, n = only_a + 0.5, only_b + 0.5, pairs + 2.0
    middle = (b - a) / n
    half = Z95 * math.sqrt(a + b - (b - a) ** 2 / n) / n
    return (only_b - only_a) / pairs, max(-1.0, middle - half), min(1.0, middle + half)


def independent_difference(
    successes_a: int, trials_a: int, successes_b: int, trials_b: int
) -> tuple[float, float, float]:
    """Success rate of a less that of b, other episodes, with its 95 % interval.

    Newcombe (1998), from Wilson's intervals; (0, -1, 1) without trials of either.
    """
    if min(trials_a, trials_b) == 0:
        return 0.0, -1.0, 1.0
    a, b = successes_a / trials_a, successes_b / trials_b
    low_a, high_a = wilson(successes_a, trials_a)
    low_b, high_b = wilson(successes_b, trials_b)
    low = a - b - math.hypot(a - low_a, high_b - b)
    return a - b, low, a - b + math.hypot(high_a - a, b - low_b)


def summary(records: Sequence[Record], config: Mapping[str, Any], model_id: str) -> dict[str, Any]:
    """What `--json` holds.

    Final errors are means over the episodes whose follower declared arrival, `min_clearance_m` is
    the least of those without collision; null where there are none.
    """
    count = len(records)
    declared = [r for r in records if r.outcome in {Outcome.ARRIVED, Outcome.FALSE_ARRIVAL}]
    clear = [r.min_clearance_m for r in records if r.outcome is not Outcome.COLLISION]
    successes = sum(r.success for r in records)
    return {
        "episodes": count,
        "success": _mean([r.success for r in records]),
        "success_paper": _mean([r.success_paper for r in records]),
        "ci95": list(wilson(successes, count)),
        "spl": _mean([r.spl for r in records]),
        "outcomes": {kind.value: sum(r.outcome is kind for r in records) for kind in Outcome},
        "mean_final_error_m": _mean([r.final_error_m for r in declared]),
        "mean_final_error_deg": _mean([r.final_error_deg for r in declared]),
        "min_clearance_m": min(clear, default=None),
        "config": dict(config),
        "model_id": model_id,
        "runs": [asdict(record) for record in records],
    }


def compare(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
    """Compare two summaries over the episodes they share.

    Raises:
        ConfigError: one is no summary, or they share no episode.
    """
    try:
        runs_a, runs_b = ({run["index"]: run for run in each["runs"]} for each in (a, b))
        pairs = [
            (runs_a[index]["success"], runs_b[index]["success"])
            for index in sorted(runs_a.keys() & runs_b.keys())
            if _same_episode(runs_a[index], runs_b[index])
        ]
        configs = a["config"], b["config"]
        ids = a["model_id"], b["model_id"]
    except (KeyError, TypeError) as error:
        raise ConfigError(
            f"not a result of cbe-bench single or route: {error!r} is missing"
        ) from error
    if not pairs:
        raise ConfigError(
            f"the two results share no episode: a has {configs[0]}, b has {configs[1]}; run both "
            "with the same --seed, --world and length"
        )
    only_a = sum(x and not y for x, y in pairs)
    only_b = sum(y and not x for x, y in pairs)
    difference, low, high = paired_difference(only_a, only_b, len(pairs))
    keys = sorted(configs[0].keys() | configs[1].keys())
    return {
        "pairs": len(pairs),
        "unpaired": len(runs_a.keys() | runs_b.keys()) - len(pairs),
        "success_a": _mean([x for x, _ in pairs]),
        "success_b": _mean([y for _, y in pairs]),
        "only_a": only_a,
        "only_b": only_b,
        "difference": difference,
        "ci95": [low, high],
        "models": list(ids),
        "differing_config": {
            key: [configs[0].get(key), configs[1].get(key)]
            for key in keys
            if configs[0].get(key) != configs[1].get(key)
        },
    }


def _same_episode(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """A bin may have forced another drive upon one of the two."""
    return a["world_seed"] == b["world_seed"] and math.dist(a["goal"], b["goal"]) < _SAME_GOAL_M


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
