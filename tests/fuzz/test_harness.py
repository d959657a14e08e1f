"""The judge itself: what it lets pass, and what it does not."""

import pytest

from cbe.errors import MessageError

from . import harness
from .mutate import MAX_BYTES, mutants


def judged(read, tmp_path, inputs=(b"one", b"two")):
    return harness.fuzz("nothing", read, [], iter(inputs), tmp_path)


def test_values_and_refusals_pass(tmp_path):
    def read(data):
        if data == b"two":
            raise MessageError("two is one too many")

    report = judged(read, tmp_path)
    assert (report.inputs, report.accepted) == (2, 1)


def test_other_exception_is_an_escape_and_its_input_is_kept(tmp_path):
    with pytest.raises(harness.Escapes, match="ZeroDivisionError"):
        judged(lambda data: 1 // (data != b"two"), tmp_path)
    assert (tmp_path / "escape-0").read_bytes() == b"two"


@pytest.mark.parametrize("reason", ["no", "x" * (harness.MAX_REASON + 1)])
def test_refusal_that_says_nothing_or_everything_is_an_escape(tmp_path, reason):
    def read(_data):
        raise MessageError(reason)

    with pytest.raises(harness.Escapes, match="characters"):
        judged(read, tmp_path)


def test_slow_input_is_an_escape(tmp_path, monkeypatch):
    monkeypatch.setattr(harness, "MAX_INPUT_S", 0.01)
    with pytest.raises(harness.Escapes, match="for one input"):
        judged(lambda _data: sum(range(3_000_000)), tmp_path)


@pytest.mark.parametrize("kept", [True, False])
def test_growth_is_an_escape_whether_or_not_it_is_freed(tmp_path, kept):
    store = []

    def read(_data):
        grown = b"\1" * (harness.MAX_GROWTH_BYTES + 2**23)  # others' garbage may go meanwhile
        if kept:
            store.append(grown)

    with pytest.raises(harness.Escapes, match="memory grew"):
        judged(read, tmp_path, inputs=(b"one",))


def test_same_seed_gives_the_same_inputs_and_another_seed_others():
    def first(seed):
        stream = mutants([b"some example", b"x" * 70_000], seed)
        return [next(stream) for _ in range(200)]

    assert first(1) == first(1)
    assert first(1) != first(2)
    assert len(set(first(1))) > 150
    assert max(map(len, first(1))) <= MAX_BYTES
