"""A link between a simulated robot and a follower, in simulated time, that a fault can spoil."""

import heapq
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from cbe.codec import Message
from cbe.inbox import Latest
from cbe.topics import Topic

M = TypeVar("M", bound=Message)

TRANSPORT_S = 0.001
BURST_S = 0.0002  # from one message to the next of those that were held up
OVERTAKEN_S = 0.15  # later than the next message of its kind


class Timeline:
    """Simulated time: it goes forward only, past everything that was due until then."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0

    def clock(self) -> float:
        """Now, in place of `time.monotonic`."""
        return self.now_s

    def at(self, when_s: float, action: Callable[[], None]) -> None:
        """Have something happen, after what else is due at the same time."""
        heapq.heappush(self._due, (when_s, self._count, action))
        self._count += 1

    def advance(self, to_s: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let time pass, at most until something comes true; a time gone by does nothing."""
        while self._due and self._due[0][0] <= to_s:
            when_s, _, action = heapq.heappop(self._due)
            self.now_s = max(self.now_s, when_s)
            action()
            if until():
                return
        self.now_s = max(self.now_s, to_s)


@dataclass(frozen=True, slots=True)
class Lane:
    """What befalls the messages of one topic; shares are of messages, drawn at random.

    `held` keeps them all back until the fault is over: then they come at once.
    """

    lost: float = 0.0
    late_s: float = 0.0
    jitter_s: float = 0.0  # late by up to so much more
    overtaken: float = 0.0
    doubled: float = 0.0
    held: bool = False


CLEAR = Lane()


class FaultyLink:
    """Stands for `cbe.link.Link` on both ends: real CDR bytes in the runtime's own inboxes."""

    def __init__(self, timeline: Timeline, rng: np.random.Generator) -> None:
        self._timeline = timeline
        self._rng = rng
        self._inboxes: dict[str, Latest[Any]] = {}
        self._sent: dict[str, int] = {}
        self._held = 0

    def latest(self, topic: Topic[M]) -> Latest[M]:
        """A slot with the newest message of a topic, stamped with simulated time."""
        inbox = Latest(topic.message.from_cdr, self._timeline.clock)
        self._inboxes[topic.name] = inbox
        return inbox

    def send(self, topic: Topic[M], message: M, lane: Lane = CLEAR, until_s: float = 0.0) -> None:
        """Send a message over a lane; what is held comes at `until_s`."""
        sequence = self._sent[topic.name] = self._sent.get(topic.name, 0) + 1
        inbox, payload = self._inboxes[topic.name], message.to_cdr()
        for delay_s in self._delays(lane, until_s):
            self._timeline.at(
                self._timeline.now_s + delay_s, lambda: inbox.store(payload, sequence)
            )

    def _delays(self, lane: Lane, until_s: float) -> list[float]:
        """Of each copy that arrives."""
        # Always as many numbers, so that a fault changes nothing about those after it.
        lost, overtaken, doubled, jitter, again = self._rng.random(5)
        if lost < lane.lost:
            return []
        if lane.held:
            self._held += 1
            return [until_s - self._timeline.now_s + self._held * BURST_S]
        delay_s = TRANSPORT_S + lane.late_s + jitter * lane.jitter_s
        delay_s += OVERTAKEN_S * (overtaken < lane.overtaken)
        return [delay_s, delay_s + again * OVERTAKEN_S] if doubled < lane.doubled else [delay_s]
