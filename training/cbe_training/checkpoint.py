"""Checkpoints: safetensors and a JSON of everything else, enough to go on exactly."""

import json
import logging
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from cbe.errors import ModelError
from cbe_training.config import LossWeights, NetworkConfig, TrainConfig
from cbe_training.networks import BehaviorNetworks

logger = logging.getLogger(__name__)


def config_from_json(text: str) -> TrainConfig:
    """Rebuild the configuration that `save` wrote."""
    values = json.loads(text)["config"]
    network = values.pop("network")
    network = {k: tuple(v) if isinstance(v, list) else v for k, v in network.items()}
    loss = LossWeights(**values.pop("loss"))
    return TrainConfig(**values, network=NetworkConfig(**network), loss=loss)


def load_networks(folder: Path) -> BehaviorNetworks:
    """The averaged networks of a checkpoint folder, as they are exported.

    Raises ModelError if the folder holds no checkpoint.
    """
    for path in (folder / "state.json", folder / "average.safetensors"):
        if not path.is_file():
            raise ModelError(f"no checkpoint at {folder}: {path.name} is missing; run cbe-train")
    config = config_from_json((folder / "state.json").read_text()).network
    networks = BehaviorNetworks(config)
    networks.load_state_dict(load_file(folder / "average.safetensors"))
    return networks.eval()


def pack(run: Path, folder: Path) -> None:
    """Copy what a later run needs to go on and an export needs, small enough to commit.

    Weights are the averaged ones in half precision; the optimiser's moments stay behind.
    Raises ModelError if `run` holds no checkpoint.
    """
    load_networks(run)
    folder.mkdir(parents=True, exist_ok=True)
    weights = load_file(run / "average.safetensors")
    _save(folder / "average.safetensors", {k: v.half() for k, v in weights.items()})
    for name in ("state.json", "log.csv", "curve.png"):
        if (run / name).is_file():
            (folder / name).write_bytes((run / name).read_bytes())


class Learner:
    """What changes while training: networks, optimiser, moving average, iteration."""

    def __init__(self, config: TrainConfig, device: torch.device, *, bf16: bool = False) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.device = device
        self.bf16 = bf16
        self.networks = BehaviorNetworks(config.network).to(device)
        self.average = BehaviorNetworks(config.network).to(device)
        self.average.load_state_dict(self.networks.state_dict())
        self.optimizer = torch.optim.AdamW(
            self.parameters,
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
        )
        self.iteration = 0
        self.updates = 0
        self.sequences = 0
        self.seconds = 0.0

    @property
    def parameters(self) -> list[torch.nn.Parameter]:
        """Everything the optimiser moves."""
        return list(self.networks.parameters())

    def update_average(self) -> None:
        """Move the averaged weights towards the present ones."""
        decay = min(self.config.average_decay, (1 + self.updates) / (10 + self.updates))
        with torch.no_grad():
            for mean, value in zip(
                self.average.parameters(), self.networks.parameters(), strict=True
            ):
                mean.lerp_(value, 1.0 - decay)

    def save(self, folder: Path) -> None:
        """Write all files; each replaces the old one only when whole."""
        folder.mkdir(parents=True, exist_ok=True)
        moments: dict[str, dict[str, Tensor]] = {"exp_avg": {}, "exp_avg_sq": {}}
        steps = {}
        for index, values in self.optimizer.state_dict()["state"].items():
            steps[str(index)] = int(values["step"])
            for name, kept in moments.items():
                kept[str(index)] = values[name]
        _save(folder / "average.safetensors", self.average.state_dict())
        _save(folder / "networks.safetensors", self.networks.state_dict())
        for name, kept in moments.items():
            _save(folder / f"{name}.safetensors", kept)
        state = {
            "config": asdict(self.config),
            "iteration": self.iteration,
            "updates": self.updates,
            "sequences": self.sequences,
            "seconds": round(self.seconds, 1),
            "optimizer_steps": steps,
        }
        temporary = folder / "state.json.part"
        temporary.write_text(json.dumps(state, indent=1) + "\n")
        temporary.replace(folder / "state.json")

    def load(self, folder: Path) -> None:
        """Go on where `save` left off, or from a packed checkpoint with fresh moments."""
        networks = folder / "networks.safetensors"
        if not networks.is_file():
            networks = folder / "average.safetensors"
        self.networks.load_state_dict(load_file(networks))
        self.average.load_state_dict(load_file(folder / "average.safetensors"))
        state = json.loads((folder / "state.json").read_text())
        self.iteration, self.updates = state["iteration"], state["updates"]
        self.sequences, self.seconds = state["sequences"], state["seconds"]
        names = ("exp_avg", "exp_avg_sq")
        if not all((folder / f"{name}.safetensors").is_file() for name in names):
            logger.warning("%s holds no optimiser moments: they start afresh", folder)
            return
        first, second = (load_file(folder / f"{name}.safetensors") for name in names)
        optimizer = self.optimizer.state_dict()
        optimizer["state"] = {
            int(index): {
                "step": torch.tensor(float(state["optimizer_steps"][index])),
                "exp_avg": first[index],
                "exp_avg_sq": second[index],
            }
            for index in first
        }
        self.optimizer.load_state_dict(optimizer)


def _save(path: Path, tensors: dict[str, Tensor]) -> None:
    temporary = path.with_suffix(".part")
    save_file({name: value.contiguous().cpu() for name, value in tensors.items()}, temporary)
    temporary.replace(path)
