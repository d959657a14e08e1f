"""How likely the robot is lost, from what the networks say tick after tick."""

from __future__ import annotations

import math
from dataclasses import dataclass

SUREST_LOG_ODDS = 5.0
"""Of a belief: however long all went well, a second or two must be able to turn it."""


@dataclass(frozen=True, slots=True)
class LostConfig:
    """The belief's figures, of the shipped model (`cbe-bench kidnap --stop 0.999` measures).

    An `on_route` whose log odds are above `usual` speaks for the route, one below against it.
    """

    usual: float = 2.5  # a probability of 0.92
    clip: float = 3.0  # what one tick can tell at most, before its weight
    weight: float = 0.5  # ticks that follow one another tell much the same
    per_tick: float = 0.001  # probability of getting lost in any one tick
    stop: float = 0.97  # a probability of being lost above this is LOST
    unlike_end: float = 0.33  # where the view is more unlike its attractor, no route ends
    unlike_rest: float = 0.25  # nor where all views while the robot parked were, and
    narrow: float = 0.7  # less for a narrower camera: times the share it sees to this power
    doubt_rest: float = 0.02  # nor where it then was so probably off the route
    apart_rest_m: float = 0.3  # nor where view and waypoint at last put the end so far apart
    nearer_rest_m: float = 0.1  # nor where it came no nearer than that over the `Approach`:
    wide: float = 0.8  # a camera that sees less of the view than that reads too unsteadily to tell


class LostBelief:
    """Two states, on the route and lost; the log odds of the second are kept."""

    def __init__(self, config: LostConfig, prior: float = 0.0) -> None:
        self._config = config
        self.log_odds = _bounded(log_odds(prior))

    @property
    def probability(self) -> float:
        """Of being lost."""
        return 1.0 / (1.0 + math.exp(-self.log_odds))

    @property
    def lost(self) -> bool:
        """Whether that is too much to drive on."""
        return self.probability > self._config.stop

    def update(self, on_route: float) -> None:
        """Take a tick's probability of being on the route."""
        config = self._config
        self._add(min(max(config.usual - log_odds(on_route), -config.clip), config.clip))

    def contradict(self) -> None:
        """Take it that the place is plainly not what it should be."""
        self._add(2.0 * self._config.clip)  # outweighs what the networks say on the same tick

    def _add(self, evidence: float) -> None:
        config = self._config
        drifted = self.probability + (1.0 - self.probability) * config.per_tick
        self.log_odds = _bounded(log_odds(drifted) + config.weight * evidence)


def log_odds(probability: float) -> float:
    """Of a probability, kept finite."""
    sure = min(max(probability, 1e-6), 1.0 - 1e-6)
    return math.log(sure / (1.0 - sure))


def _bounded(log_odds: float) -> float:
    return min(max(log_odds, -SUREST_LOG_ODDS), SUREST_LOG_ODDS)
