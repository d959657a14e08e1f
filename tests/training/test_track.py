"""Labels along a demonstrated path."""

import numpy as np

from cbe import geometry
from cbe.signature import OVERRUN_M
from cbe_training import track

STRAIGHT = np.stack([np.arange(41) * 0.05, np.zeros(41), np.zeros(41)], axis=-1)


def _label(pose: list[float], last: int, path: np.ndarray = STRAIGHT) -> track.Labels:
    return track.label(track.Paths.build([path]), np.array([pose]), np.array([last]), 0.6)


def test_waypoint_lies_ahead_on_the_path_in_the_robots_frame() -> None:
    labels = _label([0.5, 0.2, np.pi / 2], 10)
    assert labels.closest[0] == 10
    np.testing.assert_allclose(labels.distance_m, [0.2], atol=1e-9)
    # 0.6 m along the path is at (1.1, 0): to the right and behind a robot facing +y.
    np.testing.assert_allclose(labels.waypoint_m[0], [-0.2, -0.6], atol=1e-9)


def test_waypoint_runs_on_straight_for_a_little_past_the_paths_end() -> None:
    turned = geometry.compose(np.array([0.0, 0.0, 0.7]), STRAIGHT)
    for x_m, expected_m in ((1.6, 0.6), (1.9, 0.1 + OVERRUN_M), (2.1, OVERRUN_M - 0.1)):
        pose = geometry.compose(np.array([0.0, 0.0, 0.7]), np.array([x_m, 0.0, 0.0]))
        labels = _label(list(pose), 36, turned)
        np.testing.assert_allclose(labels.waypoint_m[0], [expected_m, 0.0], atol=1e-9)


def test_progress_is_the_share_of_arc_length() -> None:
    np.testing.assert_allclose(_label([0.5, 0.0, 0.0], 8).progress, [0.25])
    np.testing.assert_allclose(_label([2.4, 0.0, 0.0], 38).progress, [1.0])


def test_a_path_that_crosses_itself_is_searched_near_the_last_sample() -> None:
    out = np.stack([np.arange(60) * 0.05, np.zeros(60), np.zeros(60)], axis=-1)
    back = out[::-1] + np.array([0.0, 0.01, 0.0])
    path = np.concatenate([out, back])
    assert _label([0.5, 0.004, 0.0], 9, path).closest[0] == 10
    assert _label([0.5, 0.004, 0.0], 108, path).closest[0] == 109


def test_padding_does_not_move_the_goal() -> None:
    paths = track.Paths.build([STRAIGHT, STRAIGHT[:10]])
    np.testing.assert_allclose(paths.goals[1], STRAIGHT[9])
    np.testing.assert_allclose(paths.total_m, [2.0, 0.45])


def test_labels_do_not_depend_on_the_worlds_frame() -> None:
    moved = np.array([3.0, -2.0, 1.1])
    robot = np.array([0.4, 0.3, -0.2])
    here = _label(list(robot), 5)
    path = geometry.compose(moved, STRAIGHT)
    there = _label(list(geometry.compose(moved, robot)), 5, path)
    np.testing.assert_allclose(there.waypoint_m, here.waypoint_m, atol=1e-9)
    assert there.closest[0] == here.closest[0]
