"""Near a joint the robot heads for the path behind it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cbe.errors import ModelError
from cbe.signature import LOOKAHEAD_M, OVERRUN_M, SHAPE_POINTS
from cbe_runtime.behavior import Behavior
from cbe_runtime.networks import Networks, Prediction
from cbe_runtime.onward import Onward

RADIUS_M = 0.5
SHARES = np.arange(1, SHAPE_POINTS + 1) / SHAPE_POINTS
STRAIGHT = np.column_stack([3.0 * SHARES, 0.0 * SHARES])
LEFT = RADIUS_M * np.column_stack([np.sin(3.0 * SHARES), 1.0 - np.cos(3.0 * SHARES)])


def before_the_end(left_m, yaw_rad=0.0):
    """What a robot on the path sees so far before its end, which is turned by `yaw_rad`."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    beyond_m = min(LOOKAHEAD_M - left_m, OVERRUN_M)
    waypoint_m = np.array([left_m + beyond_m * cos, beyond_m * sin])
    return Prediction(waypoint_m, 1.0 - left_m / 3.0, 1.0, np.array([left_m, 0.0, cos, sin]))


def arc(length_m):
    """Point of the turn so far along."""
    angle = length_m / RADIUS_M
    return RADIUS_M * np.array([math.sin(angle), 1.0 - math.cos(angle)])


@pytest.mark.parametrize("left_m", [0.05, 0.25, 0.5])
def test_waypoint_lies_on_the_next_path(left_m):
    waypoint_m = Onward(STRAIGHT, LEFT).waypoint_m(before_the_end(left_m))
    expected = arc(LOOKAHEAD_M - left_m) + np.array([left_m, 0.0])
    np.testing.assert_allclose(waypoint_m, expected, atol=2e-3)


def test_next_path_starts_as_the_end_is_turned():
    right_m = Onward(STRAIGHT, LEFT).waypoint_m(before_the_end(0.1, -0.5 * math.pi))
    x, y = arc(LOOKAHEAD_M - 0.1)
    np.testing.assert_allclose(right_m, (0.1 + y, -x), atol=2e-3)


def test_far_from_the_end_the_waypoint_stays():
    prediction = replace(before_the_end(0.5), progress=0.5)
    assert Onward(STRAIGHT, LEFT).waypoint_m(prediction) is prediction.waypoint_m


def test_straight_on_the_waypoint_stays_as_far_ahead():
    for left_m in (0.0, 0.2, 0.4):
        waypoint_m = Onward(STRAIGHT, STRAIGHT).waypoint_m(before_the_end(left_m))
        np.testing.assert_allclose(waypoint_m, (LOOKAHEAD_M, 0.0), atol=1e-6)


def test_only_a_joint_is_led_past(model_writer, shape_writer, route, tmp_path):
    model_writer(tmp_path)
    shape_writer(tmp_path, LEFT)
    networks, prediction = Networks.load(tmp_path), before_the_end(0.1)
    first, last = (Behavior(networks, route, k) for k in (0, len(route.segments) - 1))
    assert first.waypoint_m(prediction) != tuple(prediction.waypoint_m)
    assert last.waypoint_m(prediction) == tuple(prediction.waypoint_m)


def test_next_path_is_read_in_a_step_without_a_tick(
    model_writer, shape_writer, route, tmp_path, monkeypatch
):
    model_writer(tmp_path)
    shape_writer(tmp_path, LEFT)
    behavior = Behavior(Networks.load(tmp_path), route, 0)
    ahead_m = Behavior(Networks.load(tmp_path), route, 0).waypoint_m(before_the_end(0.1))
    behavior.look_onward()
    monkeypatch.setattr(Networks, "path_m", None)
    assert behavior.waypoint_m(before_the_end(0.1)) == ahead_m


def test_model_without_shape_drives_on_straight(networks, route):
    prediction = before_the_end(0.1)
    assert Behavior(networks, route, 0).waypoint_m(prediction) == tuple(prediction.waypoint_m)


def test_shape_of_another_model_is_refused(model_writer, shape_writer, tmp_path):
    model_writer(tmp_path)
    shape_writer(tmp_path, LEFT, **{"cbe.model_id": "f" * 16})
    with pytest.raises(ModelError, match=r"shape\.onnx is of model f"):
        Networks.load(tmp_path)
