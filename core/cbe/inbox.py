"""Where received messages wait: one slot for control, a bounded queue for recording.

Zenoh's threads only store bytes here; decoding happens in the reader's thread, so that a
malformed message is the reader's to judge and a slow reader never holds up another topic.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from cbe.errors import MessageError

T = TypeVar("T")

MAX_STREAM_BYTES = 32 * 2**20
"""Of messages that wait for a recorder: some seconds of raw images, a minute of compressed ones."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One message as it came: `received_s` by the monotonic clock, `count` from 1 up."""

    payload: bytes
    received_s: float
    count: int


@dataclass(frozen=True, slots=True)
class Received(Generic[T]):
    """The newest message, or why it could not be read; times as in `Sample`."""

    message: T | None
    error: MessageError | None
    received_s: float
    count: int


@dataclass(frozen=True, slots=True)
class InboxStats:
    """Counts since opening.

    `overwritten` were replaced before they were read, `lost` are gaps in the sender's sequence,
    `malformed` did not decode.
    """

    received: int
    overwritten: int
    lost: int
    malformed: int


class Latest(Generic[T]):
    """One slot that holds the newest message of a topic."""

    def __init__(
        self, decode: Callable[[bytes], T], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._decode = decode
        self._clock = clock
        self._arrived = threading.Condition()
        self._sample: Sample | None = None
        self._read: Received[T] | None = None
        self._overwritten = self._lost = self._malformed = 0
        self._sequence: int | None = None

    def store(self, payload: bytes, sequence: int | None = None) -> None:
        """Called by the link's thread; `sequence` is the sender's, where it sends one."""
        received_s = self._clock()
        with self._arrived:
            count = 1 if self._sample is None else self._sample.count + 1
            if self._sample is not None and not self._is_read(self._sample):
                self._overwritten += 1
            if sequence is not None and self._sequence is not None:
                # A restarted sender counts from its beginning: nothing is known to be lost.
                self._lost += max(0, sequence - self._sequence - 1)
            self._sequence = sequence
            self._sample = Sample(payload, received_s, count)
            self._arrived.notify_all()

    def get(self) -> Received[T] | None:
        """The newest message, decoded once; None if none ever came."""
        with self._arrived:
            sample, read = self._sample, self._read
        if sample is None or (read is not None and read.count == sample.count):
            return read
        message, error = None, None
        try:
            message = self._decode(sample.payload)
        except MessageError as malformed:
            # A copy: the caught one's frames hold this call's, which holds the message before.
            error = MessageError(str(malformed))
        received = Received(message, error, sample.received_s, sample.count)
        with self._arrived:
            self._malformed += error is not None
            self._read = received
        return received

    def wait(self, after: int = 0, timeout_s: float | None = None) -> Received[T] | None:
        """The newest message once its count is above `after`; None if that takes too long."""
        with self._arrived:
            newer = self._arrived.wait_for(
                lambda: self._sample is not None and self._sample.count > after, timeout_s
            )
        return self.get() if newer else None

    @property
    def stats(self) -> InboxStats:
        """Counts since opening."""
        with self._arrived:
            received = self._sample.count if self._sample else 0
            return InboxStats(received, self._overwritten, self._lost, self._malformed)

    def _is_read(self, sample: Sample) -> bool:
        return self._read is not None and self._read.count >= sample.count


class Stream:
    """A queue of every message of a topic, for a recorder; drops the oldest when full."""

    def __init__(self, capacity: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._arrived = threading.Condition()
        self._capacity = capacity
        self._samples: deque[Sample] = deque()
        self._count = self._bytes = self._dropped = 0

    def store(self, payload: bytes, sequence: int | None = None) -> None:
        """Called by the link's thread."""
        del sequence  # a recorder keeps what comes
        received_s = self._clock()
        with self._arrived:
            self._count += 1
            self._bytes += len(payload)
            self._samples.append(Sample(payload, received_s, self._count))
            while len(self._samples) > self._capacity or self._bytes > MAX_STREAM_BYTES:
                self._bytes -= len(self._samples.popleft().payload)
                self._dropped += 1
            self._arrived.notify_all()

    def drain(self, timeout_s: float = 0.0) -> list[Sample]:
        """Take all that came, oldest first, after waiting up to `timeout_s` for the first."""
        with self._arrived:
            self._arrived.wait_for(lambda: bool(self._samples), timeout_s)
            samples = list(self._samples)
            self._samples.clear()
            self._bytes = 0
        return samples

    @property
    def dropped(self) -> int:
        """Messages pushed out before they were taken."""
        with self._arrived:
            return self._dropped
