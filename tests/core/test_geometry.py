import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cbe.geometry import compose, from_frame, relative, to_frame, wrap_angle

coordinate = st.floats(-50.0, 50.0)
poses = st.tuples(coordinate, coordinate, st.floats(-3.1, 3.1)).map(np.array)
points = st.tuples(coordinate, coordinate).map(np.array)


@given(poses, poses)
def test_relative_undoes_compose(a, b):
    assert np.allclose(relative(a, compose(a, b)), b, atol=1e-9)


@given(poses, poses, poses)
def test_compose_is_associative(a, b, c):
    left, right = compose(compose(a, b), c), compose(a, compose(b, c))
    assert np.allclose(left[:2], right[:2], atol=1e-9)
    assert abs(wrap_angle(left[2] - right[2])) < 1e-9


@given(poses, points)
def test_from_frame_undoes_to_frame(pose, point):
    assert np.allclose(from_frame(pose, to_frame(pose, point)), point, atol=1e-9)


@given(st.floats(-100.0, 100.0))
def test_wrapped_angle_is_the_same_direction_within_one_turn(angle):
    wrapped = wrap_angle(np.array(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)])


def test_point_ahead_of_a_robot_facing_left_lies_on_positive_x():
    assert np.allclose(to_frame(np.array([1.0, 2.0, np.pi / 2]), np.array([1.0, 5.0])), [3.0, 0.0])
