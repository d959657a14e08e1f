"""Command line of cbe-train."""

import argparse
import logging
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from cbe.errors import CbeError
from cbe_training import team
from cbe_training.checkpoint import pack
from cbe_training.config import Learn, Material, TrainConfig
from cbe_training.train import train


def main() -> int:
    """Train, resuming whatever the run's folder holds; returns an exit code."""
    parser = argparse.ArgumentParser(
        prog="cbe-train", description="Train the behavior networks on simulated drives."
    )
    parser.add_argument("--run", type=Path, default=Path("runs/default"), help="folder of the run")
    parser.add_argument("--hours", type=float, default=1.0, help="how much longer to train")
    parser.add_argument(
        "--learn",
        choices=[what.value for what in Learn],
        default=Learn.ALL.value,
        help="views: convolutions only; behaviors: all else, 3 times faster than all",
    )
    parser.add_argument("--learning-rate", type=float, default=TrainConfig().learning_rate)
    parser.add_argument(
        "--decay-hours", type=float, default=0.0, help="let the learning rate fall at the end"
    )
    parser.add_argument(
        "--pack", type=Path, metavar="FOLDER", help="only copy the run's weights, in half precision"
    )
    parser.add_argument("--seed", type=int, default=0, help="worlds and draws of this run")
    parser.add_argument("--worlds", type=int, default=TrainConfig().worlds)
    parser.add_argument(
        "--plan",
        type=Path,
        nargs="+",
        default=[],
        metavar="MAP.yaml",
        help="floor plans (as map_server's) to drive in beside the generated worlds",
    )
    parser.add_argument(
        "--footage",
        type=Path,
        nargs="+",
        default=[],
        metavar="DRIVE.npz",
        help="recorded drives to learn from too, as cbe-route frames writes them",
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--workers", type=int, default=0, help="processes (default: one a core, one with a GPU)"
    )
    parser.add_argument(
        "--bf16",
        action=argparse.BooleanOptionalAction,
        help="bfloat16 arithmetic (default: with a GPU; most CPUs only emulate it)",
    )
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    workers = arguments.workers or (1 if device.type != "cpu" else os.cpu_count() or 1)
    config = replace(
        TrainConfig(),
        seed=arguments.seed,
        worlds=arguments.worlds,
        learning_rate=arguments.learning_rate,
    )
    bf16 = device.type == "cuda" if arguments.bf16 is None else arguments.bf16
    work = partial(
        _work,
        config,
        arguments.run,
        arguments.hours,
        device,
        what=Learn(arguments.learn),
        decay_hours=arguments.decay_hours,
        bf16=bf16,
        material=Material(tuple(arguments.plan), tuple(arguments.footage)),
    )
    try:
        if arguments.pack is not None:
            pack(arguments.run, arguments.pack)
        else:
            team.run(work, workers)
    except CbeError as error:
        sys.stderr.write(f"cbe-train: {error}\n")
        return 1
    return 0


def _work(
    config: TrainConfig,
    folder: Path,
    hours: float,
    device: torch.device,
    member: team.Team,
    *,
    what: Learn,
    decay_hours: float,
    bf16: bool,
    material: Material,
) -> None:
    level = logging.INFO if member.rank == 0 else logging.WARNING
    logging.basicConfig(level=level, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    train(
        config,
        folder,
        hours,
        device,
        member,
        what=what,
        decay_hours=decay_hours,
        bf16=bf16,
        material=material,
    )
