"""What the runtime refuses at its start, before anything moves."""

import pytest


@pytest.fixture
def refused(start, endpoint):
    """Start a runtime that must refuse; what it says."""

    def refused(route, model):
        runtime = start("cbe-runtime", "--memory", route, "--model", model, "--connect", endpoint)
        assert runtime.wait() == 2
        assert "Traceback" not in runtime.output
        return runtime.output

    return refused


def test_route_of_another_model_is_refused(refused, route, make_model, tmp_path):
    other = make_model(tmp_path / "other", **{"cbe.model_id": "ffffffffffffffff"})

    output = refused(route, other)

    assert "taught with model 00112233445566aa" in output
    assert "ffffffffffffffff" in output


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_truncated_route_is_refused(refused, route, model, tmp_path, share):
    whole = route.read_bytes()
    cut = tmp_path / "cut.msgpack"
    cut.write_bytes(whole[: int(share * len(whole))])

    assert str(cut) in refused(cut, model)


def test_damaged_route_is_refused(refused, route, model, tmp_path):
    damaged = bytearray(route.read_bytes())
    damaged[-10] ^= 1
    path = tmp_path / "damaged.msgpack"
    path.write_bytes(damaged)

    assert "damaged" in refused(path, model)


def test_absent_robot_is_named(refused, route, model, endpoint):
    assert endpoint in refused(route, model)
