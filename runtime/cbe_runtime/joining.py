"""Finds a robot's segment and place on a route: behaviors compete on the same frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from cbe_runtime.behavior import Behavior
from cbe_runtime.likeness import unlikeness
from cbe_runtime.lost import LostBelief, LostConfig, log_odds
from cbe_runtime.sight import Sight

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cbe_runtime.networks import Networks, Prediction
    from cbe_runtime.route import Route


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """A place on a route: `progress` 0 to 1 over `segment`; `confidence` is a probability."""

    segment: int
    progress: float
    confidence: float

    def share_of(self, route: Route) -> float:
        """The share of the route's steps that lie behind."""
        steps = [segment.steps for segment in route.segments]
        progress = min(max(self.progress, 0.0), 1.0)
        return (sum(steps[: self.segment]) + progress * steps[self.segment]) / sum(steps)


def advice(place: Whereabouts | None, route: Route) -> str:
    """What a person can do for a lost robot that most likely is at `place`."""
    start = "to the route's start and call start, or anywhere onto the route: it then looks again"
    if place is None:
        return f"carry the robot {start}"
    return (
        f"nothing certain; likeliest is segment {place.segment + 1} of {len(route.segments)}, "
        f"{100.0 * place.share_of(route):.0f} % of the way along ({100.0 * place.confidence:.0f} % "
        f"sure). Carry the robot {start}"
    )


@dataclass(frozen=True, slots=True)
class JoinConfig:
    """What bounds the search; what makes it certain is the evidence of `LostConfig`.

    A tick costs one encoder and `at_once` generators at most, however long the route.
    """

    at_once: int = 16  # segments tried on one frame, standing
    hypotheses: int = 6  # that are kept, to be driven along
    usual: float = 0.0  # log odds of `on_route` that refute nothing: midway no end is in sight
    suspected: float = 0.5  # hope after a first frame that is worth driving on
    certain: float = 0.99
    least_ticks: int = 8  # driven before being certain
    lead: float = 6.0  # in summed log odds, that the best needs over the next; without it,
    decided_ticks: int = 30  # the best is taken after so many: two segments may well look alike
    most_ticks: int = 60
    creep_mps: float = 0.25
    moved: float = 0.1  # unlikeness of a view from another place than the last search's


class Hypothesis:
    """That the robot is on a segment: a behavior of its own, and how it has fared.

    `belief` is what it is to drive on with, `doubt` a more lenient one that refutes it.
    """

    def __init__(self, behavior: Behavior, evidence: LostConfig, usual: float) -> None:
        self.behavior = behavior
        self.belief = LostBelief(evidence, prior=0.5)
        self.doubt = LostBelief(replace(evidence, usual=usual), prior=0.5)
        self.prediction: Prediction | None = None
        self.score = 0.0  # log odds to be on the route, summed: unlike a belief it never saturates

    def follow(self, sight: Sight) -> None:
        """Take a frame; raises ModelError."""
        self.prediction = self.behavior.follow(sight)
        self.belief.update(self.prediction.on_route)
        self.doubt.update(self.prediction.on_route)
        self.score += log_odds(self.prediction.on_route)

    @property
    def place(self) -> Whereabouts:
        """Where the robot is if this holds."""
        progress = self.prediction.progress if self.prediction else 0.0
        return Whereabouts(self.behavior.segment, progress, 1.0 - self.belief.probability)


class Search:
    """One search for the robot's place, a tick at a time.

    Standing, every segment is tried on single frames, as many a tick as the config allows; then
    the best are followed together, and the robot may creep along the best of all, until one is
    certain or all are refuted. With a `hint` only the segments beside it are tried.
    """

    def __init__(
        self,
        networks: Networks,
        route: Route,
        evidence: LostConfig,
        config: JoinConfig,
        hint: Whereabouts | None = None,
    ) -> None:
        self._networks = networks
        self._route = route
        self._evidence = evidence
        self._config = config
        self.hinted = hint is not None
        segments = range(len(route.segments))
        if hint is not None:
            segments = segments[max(hint.segment - 1, 0) : hint.segment + 2]
        self._untried = list(segments)
        self._best: list[Hypothesis] = []  # the best first
        self._sight: Sight | None = None  # of the frames followed
        self._ticks = 0
        self._view: NDArray[np.float32] | None = None
        self.failed = False

    @property
    def standing(self) -> bool:
        """Whether the robot must not move yet."""
        return bool(self._untried) or not self._best

    @property
    def place(self) -> Whereabouts | None:
        """The likeliest place so far."""
        return self._best[0].place if self._best else None

    @property
    def prediction(self) -> Prediction | None:
        """What the likeliest hypothesis says."""
        return None if self.standing else self._best[0].prediction

    @property
    def found(self) -> Hypothesis | None:
        """What to go on with, once it is certain."""
        if self.standing or self._ticks < self._config.least_ticks:
            return None
        best = self._best[0]
        leads = len(self._best) == 1 or best.score - self._best[1].score > self._config.lead
        decided = leads or self._ticks >= self._config.decided_ticks
        return best if decided and best.place.confidence > self._config.certain else None

    def look(self, image: NDArray[np.uint8]) -> None:
        """Take the next frame (64, 64, 3) uint8 RGB.

        Raises:
            ModelError: an output is not finite.
        """
        if self._untried:
            self._try(Sight.of(self._networks, image, None))
        elif not self.failed:
            self._follow(Sight.of(self._networks, image, self._sight))

    def give_up(self) -> None:
        """Not look before the view is another than the next: driving on from there may harm."""
        self.failed = True

    def elsewhere(self, image: NDArray[np.uint8]) -> bool:
        """Whether the view is another than that of the search's last frame.

        Of a search that was given up, than that of the first frame since.

        Raises:
            ModelError: an output is not finite.
        """
        now = Sight.of(self._networks, image, None).attractor
        if self._view is None:
            self._view = now
        return float(unlikeness(now, self._view, 0)) > self._config.moved

    def _try(self, sight: Sight) -> None:
        """Try the next segments on a frame of their own."""
        config = self._config
        tried, self._untried = self._untried[: config.at_once], self._untried[config.at_once :]
        for segment in tried:
            hypothesis = self._begin(segment)
            hypothesis.follow(sight)
            self._best.append(hypothesis)
        self._rank()
        del self._best[config.hypotheses :]
        self._view = sight.attractor
        if not self._untried:
            kept = [each for each in self._best if each.doubt.probability < 1.0 - config.suspected]
            self.failed = not kept
            if kept:  # together they begin anew, with the next frame as the first
                self._best = [self._begin(each.behavior.segment) for each in kept]

    def _follow(self, sight: Sight) -> None:
        config = self._config
        self._sight, self._view = sight, sight.attractor
        self._ticks += 1
        for hypothesis in self._best:
            hypothesis.follow(sight)
        self._rank()
        hopeful = [each for each in self._best if not each.doubt.lost]
        if not hopeful or (self._ticks >= config.most_ticks and self.found is None):
            self.failed = True
        else:
            self._best = hopeful

    def _begin(self, segment: int) -> Hypothesis:
        behavior = Behavior(self._networks, self._route, segment)
        return Hypothesis(behavior, self._evidence, self._config.usual)

    def _rank(self) -> None:
        self._best.sort(key=lambda each: -each.score)
