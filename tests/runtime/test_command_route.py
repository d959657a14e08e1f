import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.errors import ModelError, RouteError
from cbe.signature import ATTRACTOR_SHAPE, ATTRACTOR_SIZE
from cbe_runtime import cli, drawing, routefile
from cbe_runtime.facts import differences
from cbe_runtime.likeness import ALIKE, unlikeness
from cbe_runtime.pathshape import PathShape
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision, Segment

# 1 m ahead, then 1 m to the left.
HOOK = [(x, 0.0) for x in (0.25, 0.5, 0.75, 1.0)] + [(1.0, y) for y in (0.25, 0.5, 0.75, 1.0)]


@pytest.fixture
def shaped(model_writer, shape_writer, tmp_path):
    return shape_writer(model_writer(tmp_path / "shaped"), HOOK)


@pytest.fixture
def saved(route, tmp_path):
    path = tmp_path / "route.msgpack"
    routefile.save(route, path)
    return path


def following(route, seed=5, noise=0.02):
    """A route of one segment that begins about where `route` ends."""
    rng = np.random.default_rng(seed)
    end = route.attractor(len(route.segments))
    begin = np.clip(end + noise * rng.standard_normal(ATTRACTOR_SIZE), 0, 1).astype(np.float32)
    goal = rng.random(ATTRACTOR_SIZE, np.float32)
    return replace(
        route,
        attractors=tuple(route.precision.attractor.pack(each) for each in (begin, goal)),
        segments=(Segment(route.segments[0].embedding, 17),),
        tags={"name": "kitchen", "floor": "2"},
    )


def test_unlikeness_makes_up_for_a_small_turn():
    rng = np.random.default_rng(0)
    world = rng.random((*ATTRACTOR_SHAPE[:2], ATTRACTOR_SHAPE[2] + 3)).astype(np.float32)
    views = [world[..., at : at + ATTRACTOR_SHAPE[2]].reshape(-1) for at in range(4)]
    apart = unlikeness(views[0], np.stack(views))
    assert apart[:3] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert apart[3] > ALIKE
    assert unlikeness(views[1], views[0], 0) > ALIKE


def test_paths_are_laid_end_to_end_and_turned(shaped, route):
    first, second = PathShape.load(shaped).lay(route)
    np.testing.assert_allclose(first[[0, 4, 8]], [[0, 0], [1, 0], [1, 1]], atol=1e-6)
    np.testing.assert_allclose(second[[0, 4, 8]], [[1, 1], [1, 2], [0, 2]], atol=1e-6)


def test_route_is_plotted(shaped, saved, tmp_path, capsys):
    picture = tmp_path / "route.png"
    arguments = ["plot", str(saved), "-o", str(picture), "--model", str(shaped)]
    assert cli.route_main(arguments) == 0
    assert "2 segments" in capsys.readouterr().out
    pixels = cv2.imread(str(picture))
    assert pixels is not None
    assert max(pixels.shape) <= 1200
    for colour in (drawing.FIRST, drawing.LAST, np.array(drawing.START)):
        assert (np.abs(pixels - colour).max(axis=2) < 3).sum() > 50


def test_path_without_extent_is_still_drawn():
    assert drawing.draw([np.zeros((9, 2))], "still").shape[2] == 3


def test_model_without_shape_still_drives_but_does_not_plot(model_folder, saved, tmp_path, capsys):
    arguments = ["plot", str(saved), "-o", str(tmp_path / "x.png"), "--model", str(model_folder)]
    assert cli.route_main(arguments) == 2
    assert "no shape.onnx" in capsys.readouterr().err
    assert not (tmp_path / "x.png").exists()


def test_path_of_another_model_is_refused(shape_writer, model_writer, route, tmp_path):
    folder = model_writer(tmp_path / "other")
    shape_writer(folder, HOOK, **{"cbe.model_id": "ffffffffffffffff"})
    with pytest.raises(RouteError, match="ffffffffffffffff"):
        PathShape.load(folder).lay(route)


def test_path_that_is_not_finite_is_refused(shape_writer, model_writer, route, tmp_path):
    folder = shape_writer(model_writer(tmp_path / "m"), np.full((8, 2), np.nan))
    with pytest.raises(ModelError, match="not finite"):
        PathShape.load(folder).lay(route)


def test_unwritable_picture_is_refused(tmp_path):
    with pytest.raises(RouteError, match="cannot write"):
        drawing.write_png(np.zeros((4, 4, 3), np.uint8), tmp_path / "none" / "x.png")


def test_joined_route_is_one_and_then_the_other(route):
    other = following(route)
    joined = route.join(other)
    assert joined.segments == route.segments + other.segments
    assert joined.attractors == (*route.attractors[:-1], *other.attractors)
    assert joined.tags == {"name": "hall", "floor": "2"}
    assert routefile.parse(routefile.dump(joined)) == joined


def test_route_that_begins_elsewhere_is_not_joined(route):
    with pytest.raises(RouteError, match=r"differ by 0\.\d\d, expected at most 0\.30"):
        route.join(following(route, noise=5.0))


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"model_id": "ffffffffffffffff"}, "model_id"),
        ({"network_period": 1}, "network_period"),
        ({"camera": MODEL_CAMERA.scaled(160, 120)}, "camera"),
    ],
)
def test_routes_taught_differently_are_not_joined(route, change, name):
    with pytest.raises(RouteError, match=name):
        route.join(replace(following(route), **change))


def test_routes_of_different_precision_are_not_joined(route):
    precision = Precision(AttractorPrecision.U4, EmbeddingPrecision.F16)
    other = following(route)
    coarse = replace(
        other,
        precision=precision,
        attractors=tuple(precision.attractor.pack(other.attractor(i)) for i in range(2)),
    )
    with pytest.raises(RouteError, match="precision"):
        route.join(coarse)


def test_join_writes_a_file(route, saved, tmp_path, capsys):
    routefile.save(following(route), tmp_path / "b.msgpack")
    target = tmp_path / "c.msgpack"
    arguments = ["join", str(saved), str(tmp_path / "b.msgpack"), "-o", str(target)]
    assert cli.route_main(arguments) == 0
    assert "77 steps in 3 segments" in capsys.readouterr().out
    assert routefile.load(target).steps == 77


def test_diff_finds_the_same_route_the_same(saved, capsys):
    assert cli.route_main(["diff", str(saved), str(saved)]) == 0
    assert "the same" in capsys.readouterr().out


def test_diff_says_what_a_longer_route_shares(route, saved, tmp_path, capsys):
    longer = tmp_path / "b.msgpack"
    routefile.save(route.join(following(route, noise=0.0)), longer)
    assert cli.route_main(["diff", str(saved), str(longer), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["facts"]["steps"] == [60, 77]
    assert (found["same_first"], found["same_last"]) == (2, 0)
    assert found["unlikeness"]["starts"] == 0.0
    assert "model_id" not in found["facts"]
    assert cli.route_main(["diff", str(saved), str(longer)]) == 1
    assert "one place" in capsys.readouterr().out


def test_attractors_of_different_models_are_not_compared(route):
    other = replace(route, model_id="ffffffffffffffff")
    found = differences(route, other, 1, 1)
    assert found["unlikeness"] is None
    assert found["same_first"] == 0


def test_reverse_is_refused_with_the_reason(saved, capsys):
    assert cli.route_main(["reverse", str(saved)]) == 2
    assert "one-way" in capsys.readouterr().err
