"""The architecture that ours is timed against is as large as the authors' own."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper

from cbe_bench import authors


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return authors.write(tmp_path_factory.mktemp("authors") / "authors.onnx")


def test_authors_architecture_has_their_parameters(path) -> None:
    weights = [numpy_helper.to_array(each) for each in onnx.load(path).graph.initializer]
    count = sum(weight.size for weight in weights if weight.dtype == np.float32)
    assert count == pytest.approx(17.86e6, rel=0.001)


def test_one_tick_of_it_runs(path) -> None:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    inputs = {name: np.zeros(shape, np.float32) for name, shape in authors.INPUTS.items()}
    waypoint, h = session.run(["waypoint_out", "generator_h_next"], inputs)
    assert waypoint.shape == (1, 2)
    assert h.shape == authors.INPUTS["generator_h"]
    assert np.isfinite(h).all()
