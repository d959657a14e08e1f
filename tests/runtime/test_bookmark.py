import time
from dataclasses import replace

import pytest

from cbe_runtime.bookmark import EVERY_STEPS, Bookmark
from cbe_runtime.decision import Decision
from cbe_runtime.state import State

DEADLINE_S = 30.0


class Asking:
    """A follower that keeps what it was asked."""

    def __init__(self):
        self.asked = []

    def start(self):
        self.asked.append("start")

    def relocalise(self, near=None):
        self.asked.append(near and (near.segment, near.progress))


def decision(segment=0, progress=0.0, state=State.FOLLOWING):
    return Decision(
        speed_mps=0.5, yaw_rate_rad_s=0.0, state=state, reason=None, segment=segment, segments=2,
        progress=progress, on_route=1.0, waypoint_m=None, camera_age_s=0.0, scan_age_s=0.0,
        standing=False, ticked=True,
    )  # fmt: skip


@pytest.fixture
def path(tmp_path):
    return tmp_path / "hall.msgpack.place"


def kept(path, route, *decisions):
    """A restarted follower's start after these decisions."""
    with Bookmark(path, route) as bookmark:
        for each in decisions:
            bookmark.keep(each)
    return asked(path, route)


def asked(path, route):
    follower = Asking()
    Bookmark(path, route).start(follower)
    (one,) = follower.asked
    return one


def test_first_start_is_at_the_beginning(path, route):
    assert asked(path, route) == "start"


def test_restart_goes_on_near_where_it_was(path, route):
    assert kept(path, route, decision(0, 0.9), decision(1, 0.25)) == (1, 0.25)


def test_place_is_kept_once_a_second_beside_the_joints(path, route):
    moving = [decision(1, step / 100.0) for step in range(EVERY_STEPS + 1)]
    with Bookmark(path, route) as bookmark:
        bookmark.keep(moving[0])
        deadline = time.monotonic() + DEADLINE_S
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        first = path.read_bytes()
        for each in moving[1:EVERY_STEPS]:
            bookmark.keep(each)
        assert path.read_bytes() == first
    assert kept(path, route, *moving) == (1, pytest.approx(EVERY_STEPS / 100.0))


def test_place_of_a_robot_that_does_not_know_it_is_not_kept(path, route):
    lost = [decision(0, 0.9, state) for state in (State.LOST, State.JOINING, State.STOPPED)]
    assert kept(path, route, decision(1, 0.5), *lost) == (1, 0.5)


def test_restart_after_arrival_is_at_the_beginning(path, route):
    assert kept(path, route, decision(1, 0.9), decision(1, 0.97, State.ARRIVED)) == "start"


def test_place_on_another_route_is_not_its_own(path, route):
    kept(path, route, decision(1, 0.5))
    assert asked(path, replace(route, tags={"name": "kitchen"})) == "start"


@pytest.mark.parametrize("data", [b"", b"{", b"\xff" * 2_000, b'{"segment": -1}', b"[]"])
def test_unreadable_place_is_looked_for_everywhere(path, route, data, caplog):
    path.write_bytes(data)
    assert asked(path, route) is None
    assert "unreadable" in caplog.text


def test_disk_that_cannot_be_written_is_warned_of_once(tmp_path, route, caplog):
    assert kept(tmp_path / "no" / "place", route, *(decision(i % 2) for i in range(4))) == "start"
    assert caplog.text.count("cannot keep the place") == 1
