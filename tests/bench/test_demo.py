import time
from types import SimpleNamespace

import numpy as np
import pytest

from cbe.errors import WorldError
from cbe_bench import demo_course
from cbe_bench.demo_processes import Crew, OverdueError
from cbe_bench.demo_report import ARRIVED, Drive, Repetition, Report
from cbe_bench.demo_witness import Truth, Witness, along
from cbe_hil_sim.generate import TEST_HOUSES, generate

SEEDS = (1, 2, 3)


@pytest.fixture(scope="module", params=SEEDS)
def house(request):
    world = generate(TEST_HOUSES[request.param])
    return world, demo_course.choose(world, request.param), request.param


def test_course_is_10_to_15_m_long_through_two_doors_in_free_space(house):
    world, course, _ = house
    crossed = set(demo_course.doorways(world)[world.cells(course.path)].tolist()) - {0}

    assert 9.9 <= course.length_m <= 15.1
    assert course.doors == len(crossed) >= 2
    assert world.clearance_at(course.path).min() >= demo_course.WAY_CLEARANCE_M


def test_course_is_the_same_for_the_same_seed(house):
    world, course, seed = house
    np.testing.assert_array_equal(demo_course.choose(world, seed).path, course.path)


def test_too_many_doors_are_refused_with_what_was_found(house):
    world, _, seed = house
    with pytest.raises(WorldError, match="through 50 doors"):
        demo_course.choose(world, seed, min_doors=50)


def test_start_is_jittered_by_the_seed(house):
    world, course, _ = house
    one, again, other = (demo_course.jittered_start(world, course.start, n) for n in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_bin_stands_on_the_way_and_leaves_a_gap(house):
    world, course, seed = house
    poses = np.column_stack([course.path, np.arctan2(*np.gradient(course.path, axis=0).T[::-1])])
    x, y, _ = demo_course.bin_place(world, poses, seed)
    distance = np.hypot(*(course.path - (x, y)).T)

    assert distance.min() <= demo_course.BIN_OFFSET_M + 0.05
    assert min(distance[0], distance[-1]) > demo_course.BIN_FROM_ENDS_M - 0.5
    assert world.clearance_at(np.array([x, y])) >= 0.5 * demo_course.BIN_M - 0.05


def test_progress_of_a_drive_that_crosses_itself_never_jumps():
    turn = np.linspace(0.0, 2.0 * np.pi, 400)
    eight = np.column_stack([np.sin(turn), np.sin(2.0 * turn), turn])
    share, off_m = along(eight, eight + np.array([0.05, 0.0, 0.0]))

    assert np.abs(np.diff(share)).max() < 0.05
    assert share[-1] == pytest.approx(1.0, abs=0.03)
    assert off_m.max() <= 0.05 + 1e-9


@pytest.mark.parametrize(
    ("ended", "pose", "collided", "outcome"),
    [
        (ARRIVED, (2.4, 0.2, 0.5), False, ARRIVED),
        (ARRIVED, (1.4, 0.0, 0.0), False, "FALSE ARRIVAL"),
        (ARRIVED, (2.0, 0.0, 0.6), False, "FALSE ARRIVAL"),
        (ARRIVED, (2.0, 0.0, 0.0), True, "COLLISION"),
        ("STUCK", (2.0, 0.0, 0.0), False, "STUCK"),
    ],
)
def test_only_a_true_arrival_is_a_success(tmp_path, ended, pose, collided, outcome):
    poses = np.column_stack([np.linspace(0.0, 2.0, 41), np.zeros(41), np.zeros(41)])
    recording = tmp_path / "drive.mcap"
    truths = [Truth(1, (0.0, 0.0, 0.0), 0.0, 1.0, collided), Truth(2, pose, 0.0, 1.0, False)]
    repetition = Repetition(ended, truths, (), recording, None)
    report = Report(Drive(poses, 0, recording, 2), None, 1, repetition)

    assert report.outcome == outcome
    assert report.succeeded == (outcome == ARRIVED)


def test_crew_leaves_no_process_behind_on_an_error(tmp_path):
    # Listens on loopback only, and would stay for ever.
    with pytest.raises(OverdueError), Crew(tmp_path) as crew:  # noqa: PT012
        child = crew.start("cbe-sim", "--backend", "column", "--listen", "tcp/127.0.0.1:0")
        child.wait(0.2)

    assert child.returncode is not None


class FakeInbox:
    """Hands out one message at a time, as `cbe.inbox.Latest` does."""

    def __init__(self):
        self._messages = []
        self._taken = 0

    def put(self, message):
        self._messages.append(message)
        while self._taken < len(self._messages):
            time.sleep(0.001)

    def wait(self, after, timeout_s):
        self._taken = after  # whoever asks for the next has dealt with the last
        if len(self._messages) <= after:
            time.sleep(0.001)
            return None
        return SimpleNamespace(message=self._messages[after], count=after + 1)


def test_status_heard_before_any_truth_has_no_place_in_time():
    inboxes = {"truth": FakeInbox(), "status": FakeInbox()}
    status = {
        "state": "FOLLOWING",
        "reason": None,
        "segment": 0,
        "progress": 0.0,
        "tick_ms": {},
        "camera_to_command_ms": {},
    }
    truth = {
        "stamp_ns": 50_000_000_000,
        "pose": [0.0, 0.0, 0.0],
        "speed_mps": 0.0,
        "clearance_m": None,
        "collided": False,
    }
    with Witness(SimpleNamespace(latest_json=inboxes.__getitem__)) as witness:
        inboxes["status"].put(status)
        inboxes["truth"].put(truth)
        inboxes["status"].put(status)
        assert [heard.stamp_ns for heard in witness.statuses] == [50_000_000_000]
