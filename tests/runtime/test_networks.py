import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.errors import ModelError
from cbe.signature import FEATURES
from cbe_runtime.modelfile import MAX_FILE_BYTES
from cbe_runtime.networks import Networks

IMAGE = np.full((64, 64, 3), 100, np.uint8)


def recall(networks):
    features, embedding, _ = networks.encode(IMAGE, networks.encoder_state())
    attractor = networks.attract(features)
    return networks.recall(
        attractor_first=attractor,
        attractor_start=attractor,
        attractor_goal=attractor,
        embedding_goal=embedding,
    )


def tick(networks, encoder_state, generator_state):
    features, embedding, encoder_state = networks.encode(IMAGE, encoder_state)
    attractor = networks.attract(features)
    prediction, generator_state = networks.generate(attractor, embedding, generator_state)
    return prediction, encoder_state, generator_state


def test_metadata_is_read(networks):
    assert networks.model_id == "00112233445566aa"
    assert (networks.network_period, networks.segment_steps) == (2, 40)
    assert networks.camera == MODEL_CAMERA
    assert networks.precision == "fp32"


def test_state_is_carried_from_tick_to_tick(networks):
    encoder_state, generator_state = networks.encoder_state(), recall(networks)
    progress = []
    for _ in range(3):
        prediction, encoder_state, generator_state = tick(networks, encoder_state, generator_state)
        progress.append(prediction.progress)
    np.testing.assert_allclose(progress, np.array([1, 2, 3]) / 19.5, rtol=1e-5)
    assert encoder_state[0] == generator_state.recurrent[0] == 3
    # The initial states are shared; running must not have changed them.
    assert not networks.encoder_state().any()
    assert not recall(networks).recurrent.any()


def test_shapes_are_those_promised(networks):
    features, embedding, _ = networks.encode(IMAGE, networks.encoder_state())
    assert features.shape == FEATURES
    assert embedding.shape == (32,)
    attractor = networks.attract(features)
    assert attractor.shape == (400,)
    assert 0 <= attractor.min() <= attractor.max() <= 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_output_that_is_not_finite_is_a_model_error(networks, value):
    features = np.full(FEATURES, value, np.float32)
    features[::2] = -features[::2]
    with pytest.raises(ModelError, match="not finite"):
        networks.attract(features)


def test_wrong_image_shape_is_a_model_error(networks):
    with pytest.raises(ModelError, match="encoder"):
        networks.encode(IMAGE[:32], networks.encoder_state())


def test_missing_file_is_named(tmp_path, model_writer):
    model_writer(tmp_path / "m")
    (tmp_path / "m" / "generator.onnx").unlink()
    with pytest.raises(ModelError, match=r"generator\.onnx"):
        Networks.load(tmp_path / "m")


def test_file_that_is_no_onnx_is_refused(tmp_path, model_writer):
    folder = model_writer(tmp_path / "m")
    (folder / "attractor.onnx").write_bytes(b"not a model")
    with pytest.raises(ModelError, match="no usable ONNX"):
        Networks.load(folder)


def test_oversized_file_is_refused_before_it_is_parsed(tmp_path, model_writer):
    folder = model_writer(tmp_path / "m")
    with (folder / "encoder.onnx").open("r+b") as file:
        file.truncate(MAX_FILE_BYTES + 1)
    with pytest.raises(ModelError, match="more than"):
        Networks.load(folder)


def test_graph_in_another_ones_place_is_refused_with_its_tensors(tmp_path, model_writer):
    folder = model_writer(tmp_path / "m")
    (folder / "attractor.onnx").write_bytes((folder / "encoder.onnx").read_bytes())
    with pytest.raises(ModelError, match="image"):
        Networks.load(folder)


def test_networks_of_two_models_are_refused(tmp_path, model_writer):
    folder = model_writer(tmp_path / "m")
    other = model_writer(tmp_path / "n", **{"cbe.model_id": "ffffffffffffffff"})
    (folder / "generator.onnx").write_bytes((other / "generator.onnx").read_bytes())
    with pytest.raises(ModelError, match="ffffffffffffffff"):
        Networks.load(folder)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("cbe.contract_version", "1"),
        ("cbe.model_id", "xyz"),
        ("cbe.network_period", "0"),
        ("cbe.network_period", "often"),
        ("cbe.segment_steps", "0"),
        ("cbe.camera", "{}"),
        ("cbe.camera", "{"),
        ("cbe.precision", None),
    ],
)
def test_bad_metadata_is_refused(tmp_path, model_writer, key, value):
    folder = model_writer(tmp_path / "m", **{key: value})
    with pytest.raises(ModelError):
        Networks.load(folder)
