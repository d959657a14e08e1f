import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cbe.errors import RouteError
from cbe.signature import ATTRACTOR_SIZE, EMBEDDING_SIZE
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision, Route, Segment

UNIT = hnp.arrays(np.float32, ATTRACTOR_SIZE, elements=st.floats(0, 1, width=32))
FLOATS = hnp.arrays(np.float32, EMBEDDING_SIZE, elements=st.floats(-100, 100, width=32))


@given(UNIT)
@pytest.mark.parametrize(
    ("precision", "error"),
    [
        (AttractorPrecision.F32, 0.0),
        (AttractorPrecision.U8, 0.5 / 255),
        (AttractorPrecision.U4, 0.5 / 15),
    ],
)
def test_attractor_returns_within_half_a_level(precision, error, attractor):
    stored = precision.pack(attractor)
    assert len(stored) == precision.size_bytes
    returned = precision.unpack(stored)
    assert returned.dtype == np.float32
    np.testing.assert_allclose(returned, attractor, rtol=0, atol=error + 1e-6)
    assert precision.pack(returned) == stored


@given(FLOATS)
@pytest.mark.parametrize("precision", list(EmbeddingPrecision))
def test_embedding_returns_within_its_precision(precision, embedding):
    stored = precision.pack(embedding)
    assert len(stored) == precision.size_bytes
    largest = np.abs(embedding).max()
    error = {"f32": 0.0, "f16": largest * 2.0**-11 + 1e-7, "i8": largest / 127 * 0.51}[precision]
    np.testing.assert_allclose(precision.unpack(stored), embedding, rtol=0, atol=error + 1e-30)


def test_four_bit_attractor_keeps_the_order_of_its_numbers():
    attractor = np.linspace(0, 1, ATTRACTOR_SIZE, dtype=np.float32)
    returned = AttractorPrecision.U4.unpack(AttractorPrecision.U4.pack(attractor))
    assert (np.diff(returned) >= 0).all()
    assert (returned[0], returned[-1]) == (0.0, 1.0)


def test_neighbouring_segments_share_an_attractor(route):
    assert route.attractor(1) is not None
    assert len(route.attractors) == len(route.segments) + 1
    assert route.steps == 60


def test_other_model_is_refused_with_both_ids(route, networks, model_writer, tmp_path):
    from cbe_runtime.networks import Networks

    route.require_model(networks)
    other = Networks.load(model_writer(tmp_path, **{"cbe.model_id": "ffffffffffffffff"}))
    with pytest.raises(RouteError, match=r"00112233445566aa.*ffffffffffffffff.*re-teach"):
        route.require_model(other)


@pytest.mark.parametrize(
    "change",
    [
        {"segments": ()},
        {"attractors": (bytes(400),)},
        {"attractors": (bytes(400), bytes(400), bytes(399))},
        {"segments": (Segment(bytes(64), 30), Segment(bytes(63), 30))},
        {"segments": (Segment(bytes(64), 30), Segment(bytes(64), 0))},
        {"segments": (Segment(bytes(64), 30), Segment(b"\xff\x7f" * 32, 30))},
        {
            "precision": Precision(AttractorPrecision.F32),
            "attractors": (np.full(400, np.inf, "<f4").tobytes(),) * 3,
        },
    ],
)
def test_parts_that_do_not_fit_are_refused(route, change):
    parts = {name: getattr(route, name) for name in Route.__dataclass_fields__} | change
    with pytest.raises(RouteError):
        Route(**parts)
