from itertools import product

import pytest

from cbe_runtime.state import Events, Reason, State, StateMachine

FAULT, OTHER = Reason.STALE_SCAN, Reason.BAD_IMAGE
PERSISTENT = [Reason.OPERATOR, Reason.MODEL_FAULT, Reason.TIMEOUT]
UNPLACED = (State.LOST, State.JOINING)
PLACES = [(state, None) for state in State if state is not State.STOPPED] + [
    (State.STOPPED, reason) for reason in Reason
]
YES_OR_NO = (False, True)
EVENTS = [
    Events(start, stop, fault, **dict.fromkeys(happened, True))
    for start, stop, fault in product(YES_OR_NO, YES_OR_NO, (None, FAULT))
    for happened in ((), ("arrived",), ("relocalise",), ("found",), ("lost",), ("lost", "arrived"))
]


def machine_in(place):
    machine = StateMachine()
    machine.state, machine.reason = place
    return machine


def after(place, events):
    machine = machine_in(place)
    machine.update(events)
    return machine.state, machine.reason


def expected(place, events):
    """The diagram of docs, as a table of its own."""
    state, reason = place
    halted = state in {State.IDLE, State.ARRIVED}
    if events.stop:
        return (State.IDLE, None) if halted else (State.STOPPED, Reason.OPERATOR)
    waits = halted or (state is State.STOPPED and reason in PERSISTENT)
    starting = events.start or events.relocalise
    if waits and not starting:
        return place
    if events.fault is not None:
        return State.STOPPED, events.fault
    if events.relocalise:
        return State.JOINING, None
    if events.start and state in UNPLACED:
        return State.FOLLOWING, None
    if events.lost and state in {State.FOLLOWING, *UNPLACED}:
        return State.LOST, None
    if state in UNPLACED:
        sure = {State.LOST: State.JOINING, State.JOINING: State.FOLLOWING}
        return (sure[state] if events.found else state), None
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


@pytest.mark.parametrize("unplaced", UNPLACED)
@pytest.mark.parametrize(
    ("first", "then"),
    [(Events(fault=FAULT), Events()), (Events(stop=True), Events(start=True))],
    ids=["fault that ends", "operator"],
)
def test_robot_stopped_without_knowing_its_place_looks_for_it_again(unplaced, first, then):
    machine = machine_in((unplaced, None))
    machine.update(first)
    assert machine.state is State.STOPPED
    machine.update(then)
    assert machine.state is State.JOINING
