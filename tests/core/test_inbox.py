"""Where received messages wait."""

import gc
import weakref

import pytest

from cbe.errors import MessageError
from cbe.inbox import MAX_STREAM_BYTES, Latest, Stream


class Payload:
    """Stands in for a message's bytes, so that it can be seen to go."""


def refuse(payload: object) -> object:
    try:
        raise ValueError(f"{payload} is nothing")
    except ValueError as error:
        raise MessageError("malformed") from error


def test_malformed_messages_leave_nothing_behind() -> None:
    inbox = Latest(refuse)
    gone = []
    gc.disable()
    try:
        for _ in range(3):
            payload = Payload()
            gone.append(weakref.ref(payload))
            inbox.store(payload)  # type: ignore[arg-type]
            received = inbox.get()
            assert received is not None
            assert str(received.error) == "malformed"
        del payload, received
        assert [each() is None for each in gone] == [True, True, False]
    finally:
        gc.enable()


@pytest.mark.parametrize(("size", "count", "kept"), [(8, 10, 4), (MAX_STREAM_BYTES // 3, 5, 3)])
def test_full_stream_drops_the_oldest_and_counts_them(size: int, count: int, kept: int) -> None:
    stream = Stream(4)
    payload = bytes(size)
    for _ in range(count):
        stream.store(payload)
    assert [sample.count for sample in stream.drain()] == list(range(count - kept + 1, count + 1))
    assert stream.dropped == count - kept
    stream.store(payload)
    assert len(stream.drain()) == 1


def test_message_larger_than_a_stream_is_dropped() -> None:
    stream = Stream(4)
    stream.store(bytes(MAX_STREAM_BYTES + 1))
    assert not stream.drain()
    assert stream.dropped == 1
