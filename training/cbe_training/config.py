"""One frozen configuration of a training run, stored beside every checkpoint."""

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from cbe import signature


class Learn(Enum):
    """What a piece of a run learns."""

    VIEWS = "views"  # the convolutions alone, from still views: start with this
    BEHAVIORS = "behaviors"  # the rest, the convolutions' outputs being kept from the rollout
    ALL = "all"


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """Layer widths; the trunk's and the attractor's shapes are fixed by `cbe.signature`."""

    pair_channels: tuple[int, int] = (40, 80)
    motion: int = 64
    encoder_state: int = 96
    attractor_channels: int = 64
    relation_channels: tuple[int, int] = (64, 48)
    relation: int = 64
    behavior: int = 64
    guide: int = 64
    generator_state: int = 128
    head: int = 48


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the loss terms; the auxiliary ones make a small budget enough."""

    waypoint: float = 2.0
    progress: float = 2.0
    on_route: float = 0.2
    motion: float = 1.0  # relative pose of consecutive frames
    displacement: float = 0.2  # pose since the start, in every z
    relation: float = 0.3  # relative pose of two views, from their attractors
    views: float = 0.5  # the same, of views that are not a rollout's


@dataclass(frozen=True, slots=True)
class Material:
    """What else is learnt from: floor plans (YAML) and recorded drives (.npz)."""

    plans: tuple[Path, ...] = ()
    footage: tuple[Path, ...] = ()


NOTHING_ELSE = Material()


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Sizes are episodes; lengths are network frames unless they end in `_steps`."""

    seed: int = 0
    worlds: int = 100
    depots: float = 0.6  # and so many more, times that, of these
    drives_per_world: int = 25
    demonstrations: int = 48  # behaviors shown in one iteration
    repeats: int = 2  # rollouts of each, from different starts
    epochs: int = 2  # times each rollout is trained on
    minibatch: int = 4  # behaviors in one update
    learning_rate: float = 1e-3
    warmup_updates: int = 100
    weight_decay: float = 1e-4
    clip_norm: float = 1.0
    average_decay: float = 0.998  # of the exported moving average of the weights
    view_groups: int = 8  # groups of views in one update
    view_steps: int = 48  # pairs of frames in one update
    views_alone: int = 3  # times as many where only views are learnt from
    view_updates: int = 48  # in one such iteration
    cloning_sequences: int = 21_000  # expert at the wheel, short behaviors
    annealing_sequences: int = 13_000  # the expert's share falls from 1 to 0
    expert_episodes: float = 0.1  # always driven by the (noisy) expert
    wrong_episodes: float = 0.08  # shown another behavior's memory
    joining_episodes: float = 0.15  # start in the middle of the behavior
    kidnapped_episodes: float = 0.12  # are put elsewhere on the way
    bin_episodes: float = 0.2  # meet bins that the demonstration did not
    without_attractors: float = 0.04  # behaviors learnt from z alone, as the ablation drives them
    without_embedding: float = 0.04  # and from attractors alone
    lookahead_m: float = signature.LOOKAHEAD_M
    off_route_m: float = 1.0  # a rollout further off its demonstration ends
    jitter_m: float = 0.3
    jitter_rad: float = 0.2356  # 13.5 deg
    longest_steps: int = 270  # of a behavior, at any gap between frames
    validation_every: int = 40
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossWeights = field(default_factory=LossWeights)

    def frames(self, sequences: int) -> tuple[int, int]:
        """Shortest and longest behavior, in network frames, after `sequences` trained on."""
        if sequences < self.cloning_sequences:
            return 12, 24
        if sequences < self.cloning_sequences + self.annealing_sequences:
            return 20, 40
        return 24, 136

    def expert_share(self, sequences: int) -> float:
        """Probability that a tick is driven by the expert's waypoint."""
        past = sequences - self.cloning_sequences
        return min(1.0, max(0.0, 1.0 - past / self.annealing_sequences))
