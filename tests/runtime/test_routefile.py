import hashlib
import os
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cbe.camera import CameraModel
from cbe.errors import RouteError
from cbe_runtime import routefile
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision

GOLDEN = Path(__file__).parents[1] / "golden"


def sealed(body, **envelope):
    packed = msgpack.packb(body)
    return msgpack.packb(
        {
            "magic": "cbe-route",
            "version": 1,
            "sha256": hashlib.sha256(packed).digest(),
            "body": packed,
        }
        | envelope
    )


def opened(route):
    return msgpack.unpackb(msgpack.unpackb(routefile.dump(route))["body"])


def test_route_returns_as_it_was_saved(route, tmp_path):
    route = replace(
        route, camera=CameraModel(640, 480, 312.25, 310.1, 320, 240, "fisheye", (0.1,) * 4)
    )
    size = routefile.save(route, tmp_path / "r.msgpack")
    assert (tmp_path / "r.msgpack").stat().st_size == size
    assert routefile.load(tmp_path / "r.msgpack") == route
    assert list(tmp_path.iterdir()) == [tmp_path / "r.msgpack"]


def test_golden_route_of_version_1_still_loads():
    route = routefile.load(GOLDEN / "route_v1.msgpack")
    assert route.model_id == "00112233445566aa"
    assert route.precision == Precision(AttractorPrecision.U4, EmbeddingPrecision.F16)
    assert [segment.steps for segment in route.segments] == [30, 28]
    assert route.camera.fx == 18.48
    assert route.tags == {"name": "golden"}
    ramp = np.linspace(0, 1, 400)
    np.testing.assert_allclose(route.attractor(2), ramp, atol=0.034)
    np.testing.assert_array_equal(route.embedding(1), np.arange(32) / 8)
    assert routefile.dump(route) == (GOLDEN / "route_v1.msgpack").read_bytes()


def test_overhead_beside_the_numbers_is_small(route):
    numbers = sum(map(len, route.attractors)) + sum(len(s.embedding) for s in route.segments)
    assert len(routefile.dump(replace(route, tags={}))) - numbers < 200


@given(st.binary(max_size=300))
def test_any_bytes_are_refused_as_a_route_error(data):
    with pytest.raises(RouteError):
        routefile.parse(data)


@given(st.data())
def test_any_flipped_byte_is_refused(data):
    whole = bytearray((GOLDEN / "route_v1.msgpack").read_bytes())
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] ^= data.draw(st.integers(1, 255))
    with pytest.raises(RouteError):
        routefile.parse(bytes(whole))


@given(st.integers(0, 1_500))
def test_truncated_route_is_refused(length):
    whole = (GOLDEN / "route_v1.msgpack").read_bytes()
    with pytest.raises(RouteError):
        routefile.parse(whole[: min(length, len(whole) - 1)])


@pytest.mark.parametrize(
    "change",
    [
        {"m": b"short"},
        {"p": 3},
        {"p": "2"},
        {"q": ["u9", "f16"]},
        {"q": ["u4", "f16"]},
        {"a": b""},
        {"s": []},
        {"s": [[bytes(64), -1]]},
        {"s": [[bytes(64)]]},
        {"s": 3},
        {"c": [64, 64, float("nan"), 23.68, 32.0, 32.0, "pinhole", []]},
        {"c": [64, 64, -1.0, 23.68, 32.0, 32.0, "pinhole", []]},
        {"c": [0, 64, 18.48, 23.68, 32.0, 32.0, "pinhole", []]},
        {"t": {"name": 3}},
        {"unknown": 1},
    ],
)
def test_body_out_of_range_is_refused(route, change):
    assert routefile.parse(sealed(opened(route))) == route
    with pytest.raises(RouteError):
        routefile.parse(sealed(opened(route) | change))


def test_later_version_says_to_upgrade(route):
    with pytest.raises(RouteError, match=r"version 2.*upgrade"):
        routefile.parse(sealed(opened(route), version=2))


def test_other_file_is_named_by_its_magic(route):
    with pytest.raises(RouteError, match="other"):
        routefile.parse(sealed(opened(route), magic="other"))


def test_missing_route_is_named(tmp_path):
    with pytest.raises(RouteError, match=r"nowhere\.msgpack"):
        routefile.load(tmp_path / "nowhere.msgpack")


def test_oversized_file_is_refused(tmp_path):
    with (tmp_path / "r").open("wb") as file:
        file.truncate(routefile.MAX_FILE_BYTES + 1)
    with pytest.raises(RouteError, match="larger"):
        routefile.load(tmp_path / "r")


def test_failed_save_leaves_the_old_route(route, tmp_path, monkeypatch):
    path = tmp_path / "r.msgpack"
    routefile.save(route, path)

    def full(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RouteError, match="No space"):
        routefile.save(replace(route, tags={"name": "new"}), path)
    assert routefile.load(path) == route
    assert list(tmp_path.iterdir()) == [tmp_path / "r.msgpack"]
