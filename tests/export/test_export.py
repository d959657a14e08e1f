"""Export: the graphs match the signature, parity is measured, and a failed gate writes nothing."""

import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from cbe import signature
from cbe.errors import ModelError
from cbe_export import export as export_module
from cbe_export.export import identify, write_graphs
from cbe_export.parity import GRAPHS, Rides, worst_difference
from cbe_export.quantise import quantise
from cbe_export.storing import restore_from_half, store_in_half
from cbe_runtime.networks import Networks
from cbe_runtime.pathshape import PathShape
from cbe_training.layout import path_of
from cbe_training.networks import BehaviorNetworks


@pytest.fixture(scope="module")
def networks() -> BehaviorNetworks:
    torch.manual_seed(3)
    return BehaviorNetworks().eval()


@pytest.fixture(scope="module")
def folder(networks: BehaviorNetworks, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    write_graphs(networks, folder, network_period=2, segment_steps=100)
    return folder


@pytest.fixture(scope="module")
def rides() -> Rides:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (2, 6, 64, 64, 3), dtype=np.uint8)
    return Rides(images, np.array([6, 5]), images[::-1].copy())


def test_runtime_loads_what_was_exported(folder: Path) -> None:
    loaded = Networks.load(folder)
    assert loaded.network_period == 2
    assert loaded.segment_steps == 100
    assert loaded.precision == "fp32"


def test_every_graph_carries_all_metadata(folder: Path) -> None:
    for name in GRAPHS:
        model = onnx.load(folder / f"{name}.onnx")
        assert {p.key for p in model.metadata_props} >= set(signature.METADATA_KEYS)


def test_files_say_nothing_of_the_machine_they_were_made_on(folder: Path) -> None:
    here = str(Path(__file__).parents[2]).encode()
    for path in folder.glob("*.onnx"):
        data = path.read_bytes()
        assert here not in data
        assert b"cbe_training" not in data


def test_onnxruntime_agrees_with_torch_through_the_recurrence(
    networks: BehaviorNetworks, folder: Path, rides: Rides
) -> None:
    worst, ticks = worst_difference(networks, folder, rides)
    assert ticks == 11
    assert worst < 1e-4


def test_quantised_graphs_load_and_answer_nearly_the_same(
    networks: BehaviorNetworks, folder: Path, rides: Rides, tmp_path: Path
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    other_id = write_graphs(
        networks, tmp_path, network_period=2, segment_steps=100, precision="int8"
    )
    quantise(networks, tmp_path, rides)
    loaded = Networks.load(tmp_path)
    assert loaded.precision == "int8"
    assert loaded.model_id == other_id != Networks.load(folder).model_id
    assert (tmp_path / "encoder.onnx").stat().st_size < (folder / "encoder.onnx").stat().st_size
    worst, _ = worst_difference(networks, tmp_path, rides)
    assert 1e-4 < worst < 0.5


def test_weights_come_back_from_half_as_they_were(tmp_path: Path) -> None:
    halved = BehaviorNetworks().half().float().eval()
    write_graphs(halved, tmp_path, network_period=2, segment_steps=100)
    model = onnx.load(tmp_path / "encoder.onnx")
    halves = sum(t.data_type == onnx.TensorProto.FLOAT16 for t in model.graph.initializer)
    stored = {t.name: t.raw_data for t in model.graph.initializer}
    restore_from_half(model)
    assert halves > 0
    assert all(t.data_type != onnx.TensorProto.FLOAT16 for t in model.graph.initializer)
    store_in_half(model)
    assert {t.name: t.raw_data for t in model.graph.initializer} == stored


def test_parity_notices_a_changed_weight(
    networks: BehaviorNetworks, folder: Path, rides: Rides
) -> None:
    other = BehaviorNetworks().eval()
    other.load_state_dict(networks.state_dict())
    with torch.no_grad():
        other.encoder.lstm.weight_hh_l0[0] += 0.5
    worst, _ = worst_difference(other, folder, rides)
    assert worst > 1e-4


def test_runtime_reads_the_path_that_torch_does(folder: Path) -> None:
    embedding = np.random.default_rng(0).normal(size=signature.EMBEDDING_SIZE).astype(np.float32)
    with torch.no_grad():
        expected = path_of(torch.from_numpy(embedding), signature.SHAPE_POINTS).numpy()
    np.testing.assert_allclose(PathShape.load(folder).read(embedding), expected, atol=1e-5)


def test_model_id_follows_the_weights(networks: BehaviorNetworks, folder: Path) -> None:
    before = identify(networks)
    assert Networks.load(folder).model_id == before
    changed = BehaviorNetworks().eval()
    changed.load_state_dict(networks.state_dict())
    with torch.no_grad():
        changed.generator.out.bias += 1e-4
    assert identify(changed) != before


def test_failed_parity_writes_nothing(
    networks: BehaviorNetworks,
    rides: Rides,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(export_module, "load_networks", lambda _: networks)
    monkeypatch.setattr(Rides, "record", lambda networks, cache: rides)
    monkeypatch.setattr(export_module, "write_graphs", lambda *_, **__: "0" * 16)
    monkeypatch.setattr(export_module, "worst_difference", lambda *_: (2e-4, 300))
    target = tmp_path / "models"
    with pytest.raises(ModelError, match="nothing was written"):
        export_module.export(tmp_path, target, network_period=2, segment_steps=100, cache=tmp_path)
    assert not target.exists()
