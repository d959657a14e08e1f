import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cbe.camera import MODEL_CAMERA
from cbe.errors import RouteError
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision
from cbe_runtime.teach import Teacher

EXACT = Precision(AttractorPrecision.F32, EmbeddingPrecision.F32)


def view(step):
    return np.random.default_rng(step).integers(0, 256, (64, 64, 3), np.uint8)


def taught(networks, frames, **options):
    teacher = Teacher(networks, MODEL_CAMERA, precision=EXACT, **options)
    for step in range(frames):
        teacher.feed(view(step))
    return teacher.finish({"name": "test"})


def lengths(route):
    return [segment.steps for segment in route.segments]


def encoded(networks, steps):
    state = networks.encoder_state()
    for step in steps:
        features, embedding, state = networks.encode(view(step), state)
    return networks.attract(features), embedding


def test_short_drive_is_one_behavior(networks):
    route = taught(networks, 31)
    assert lengths(route) == [30]
    attractor, embedding = encoded(networks, range(0, 31, 2))
    np.testing.assert_array_equal(route.attractor(1), attractor)
    np.testing.assert_array_equal(route.embedding(0), embedding)
    np.testing.assert_array_equal(route.attractor(0), encoded(networks, [0])[0])


def test_joint_frame_ends_one_segment_and_begins_the_next(networks):
    route = taught(networks, 61, total_steps=60)
    assert lengths(route) == [30, 30]
    np.testing.assert_array_equal(route.attractor(1), encoded(networks, [30])[0])
    np.testing.assert_array_equal(route.embedding(1), encoded(networks, range(30, 61, 2))[1])


def test_last_frame_between_two_ticks_is_seen(networks):
    route = taught(networks, 32)
    assert lengths(route) == [31]
    np.testing.assert_array_equal(route.attractor(1), encoded(networks, [31])[0])


@settings(max_examples=25)
@given(frames=st.integers(2, 260), longest=st.integers(2, 60), known=st.booleans())
def test_segments_cover_the_drive_and_none_is_too_long_or_tiny(networks, frames, longest, known):
    total = frames - 1
    route = taught(networks, frames, segment_steps=longest, total_steps=total if known else None)
    assert sum(lengths(route)) == total
    assert max(lengths(route)) <= longest
    if known:
        assert len(route.segments) == -(-total // (longest // 2 * 2))
    if total > longest >= 8 and not known:
        assert min(lengths(route)) >= longest // 2 - 2


def test_memory_does_not_grow_with_the_drive(networks):
    teacher = Teacher(networks, MODEL_CAMERA, segment_steps=20)
    held = []
    for step in range(400):
        teacher.feed(view(step))
        held.append(len(teacher._frames))
    assert max(held) <= 21
    assert teacher.segments >= 18
    assert teacher.steps == 399


def test_route_says_what_taught_it(networks):
    route = taught(networks, 5)
    assert route.model_id == networks.model_id
    assert route.network_period == networks.network_period
    assert route.tags == {"name": "test"}


@pytest.mark.parametrize("frames", [0, 1])
def test_drive_without_motion_is_refused(networks, frames):
    with pytest.raises(RouteError, match="at least two frames"):
        taught(networks, frames)


def test_adaptive_joints_lie_where_views_change_and_no_segment_is_too_long(networks):
    # The view brightens in one place only, which equal segments would pass by.
    grey = [60] * 25 + list(range(60, 240, 18)) + [240] * 100
    teacher = Teacher(networks, networks.camera, segment_steps=40, adaptive=True)
    for value in grey:
        teacher.feed(np.full((64, 64, 3), value, np.uint8))
    route = teacher.finish()
    assert route.steps == len(grey) - 1
    assert all(segment.steps <= 40 for segment in route.segments)
    assert all(segment.steps >= 15 for segment in route.segments[:-1])
    assert 26 <= route.segments[0].steps <= 36
