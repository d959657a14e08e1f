from itertools import product

import pytest

from cbe_runtime.state import Events, Reason, State, StateMachine

FAULT, OTHER = Reason.STALE_SCAN, Reason.BAD_IMAGE
PERSISTENT = [Reason.OPERATOR, Reason.MODEL_FAULT, Reason.TIMEOUT]
PLACES = [(state, None) for state in State if state is not State.STOPPED] + [
    (State.STOPPED, reason) for reason in Reason
]
EVENTS = [
    Events(*each) for each in product((False, True), (False, True), (None, FAULT), (False, True))
]


def after(place, events):
    machine = StateMachine()
    machine.state, machine.reason = place
    machine.update(events)
    return machine.state, machine.reason


def expected(place, events):
    """The diagram of docs, as a table of its own."""
    state, reason = place
    halted = state in {State.IDLE, State.ARRIVED}
    if events.stop:
        return (State.IDLE, None) if halted else (State.STOPPED, Reason.OPERATOR)
    waits = halted or (state is State.STOPPED and reason in PERSISTENT)
    if waits and not events.start:
        return place
    if events.fault is not None:
        return State.STOPPED, events.fault
    if state is State.FOLLOWING and events.arrived:
        return State.ARRIVED, None
    return State.FOLLOWING, None


@pytest.mark.parametrize("place", PLACES, ids=str)
@pytest.mark.parametrize("events", EVENTS, ids=str)
def test_every_state_answers_every_event(place, events):
    assert after(place, events) == expected(place, events)


def test_present_fault_replaces_the_one_before():
    assert after((State.STOPPED, FAULT), Events(fault=OTHER)) == (State.STOPPED, OTHER)


def test_only_stopped_has_a_reason():
    for place, events in product(PLACES, EVENTS):
        state, reason = after(place, events)
        assert (reason is not None) == (state is State.STOPPED)
