"""Networks that need no model: what benchmarks count is then known beforehand."""

import numpy as np
import pytest

from cbe.camera import MODEL_CAMERA
from cbe.signature import ATTRACTOR_SIZE, EMBEDDING_SIZE
from cbe_bench import evaluation, scenario
from cbe_runtime.networks import Networks, Prediction


class Counting:
    """Stands for `Networks`: drives ahead to an end 0.2 m nearer a tick, done after `ticks`.

    Keeps whether the attractors it was given at start and goal of a behavior were there.
    """

    model_id = "0011223344556677"
    network_period = 2
    segment_steps = 60
    on_route = 1.0
    camera = MODEL_CAMERA
    ticks = 10

    def __init__(self):
        self.given = []

    def encoder_state(self):
        return None

    def encode(self, image, state):
        return np.zeros((1, 1), np.float32), np.ones(EMBEDDING_SIZE, np.float32), None

    def attract(self, features):
        return np.ones(ATTRACTOR_SIZE, np.float32)

    def path_m(self, embedding):
        return None

    def recall(self, *, attractor_start, attractor_goal, **others):
        self.given.append((bool(attractor_start.any()), bool(attractor_goal.any())))
        return 0

    def generate(self, attractor, embedding, state):
        progress = 1.0 if state >= self.ticks else 0.0
        end = np.array([0.2 * max(self.ticks - state, 0), 0.0, 1.0, 0.0])
        return Prediction(np.array([0.3, 0.0]), progress, self.on_route, end), state + 1


@pytest.fixture
def counting(monkeypatch):
    networks = Counting()
    monkeypatch.setattr(scenario, "GROUP", 2)
    monkeypatch.setattr(evaluation, "GROUP", 2)
    monkeypatch.setattr(Networks, "load", classmethod(lambda cls, folder: networks))
    yield networks
    evaluation._networks.cache_clear()
