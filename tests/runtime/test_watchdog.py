import threading

import pytest

from cbe.errors import LinkError
from cbe_runtime.watchdog import EXIT_HUNG, POLL_S, Watchdog

DEADLINE_S = 60.0  # for what takes a moment on an idle machine


class Polled:
    """A watchdog whose thread does not run: it is polled on a clock of its own."""

    def __init__(self):
        self.now_s = 10.0
        self.stopped = threading.Event()
        self.ends = []
        self.watchdog = Watchdog(
            self.stop, self.ends.append, lambda: self.now_s, stop_s=0.35, end_s=2.0
        )
        self.watchdog._polled_s = self.now_s

    def stop(self):
        self.stopped.set()

    def pass_s(self, seconds, poll_s=POLL_S):
        for _ in range(round(seconds / poll_s)):
            self.now_s += poll_s
            self.watchdog.poll()


@pytest.fixture
def polled():
    polled = Polled()
    yield polled
    polled.watchdog._back.set()


def test_loop_that_hangs_while_driving_stops_the_robot(polled):
    polled.watchdog.beat(driving=True)
    polled.pass_s(0.35)
    assert polled.watchdog.trips == 0
    polled.pass_s(0.1)
    assert polled.stopped.wait(DEADLINE_S)
    assert polled.watchdog.trips == 1
    polled.pass_s(1.0)
    assert polled.watchdog.trips == 1
    assert polled.ends == []


def test_loop_that_hangs_for_longer_ends_the_process(polled):
    polled.watchdog.beat(driving=True)
    polled.pass_s(2.2)
    assert set(polled.ends) == {EXIT_HUNG}


def test_loop_that_ticks_is_left_alone(polled):
    for _ in range(100):
        polled.watchdog.beat(driving=True)
        polled.pass_s(0.2)
    assert (polled.watchdog.trips, polled.ends) == (0, [])


def test_standing_robot_is_not_told_to_stop(polled):
    polled.watchdog.beat(driving=False)
    polled.pass_s(1.0)
    assert polled.watchdog.trips == 0


def test_suspended_process_has_not_hung(polled):
    polled.watchdog.beat(driving=True)
    polled.pass_s(3600.0, poll_s=3600.0)  # SIGSTOP, SIGCONT
    assert (polled.watchdog.trips, polled.ends) == (0, [])


def test_loop_that_hangs_again_is_stopped_again(polled):
    for trips in (1, 2):
        polled.watchdog.beat(driving=True)
        polled.pass_s(0.5)
        assert polled.watchdog.trips == trips


@pytest.mark.parametrize("broken", ["raises", "hangs"])
def test_link_that_fails_too_does_not_keep_the_watchdog_from_ending_the_process(broken):
    release, ended = threading.Event(), threading.Event()

    def stop():
        if broken == "hangs":
            release.wait(DEADLINE_S)
        raise LinkError("closed")

    def end(code):
        assert code == EXIT_HUNG
        ended.set()

    with Watchdog(stop, end, stop_s=0.05, end_s=0.3) as watchdog:
        watchdog.beat(driving=True)
        assert ended.wait(DEADLINE_S)
        assert watchdog.trips == 1
        release.set()
        watchdog.beat(driving=False)
