"""A behavior begins where the view is most like the one it was shown to begin with."""

import numpy as np
import pytest

from cbe import signature
from cbe.camera import MODEL_CAMERA
from cbe_runtime.behavior import Behavior
from cbe_runtime.route import Precision, Route, Segment
from cbe_runtime.sight import Sight

START, GOAL = 0.5, 0.9


class GreyNetworks:
    """Stands for `Networks`: an attractor is the image's grey, the state counts frames."""

    model_id = "00112233445566aa"
    network_period = 2

    def encoder_state(self):
        return 0

    def encode(self, image, state):
        return image[0, 0, 0] / 255.0, np.zeros(signature.EMBEDDING_SIZE, np.float32), state + 1

    def attract(self, features):
        return np.full(signature.ATTRACTOR_SIZE, features, np.float32)

    def recall(self, **_):
        return 0

    def generate(self, attractor, embedding, state):
        return state + 1, state + 1


@pytest.fixture
def behavior():
    precision = Precision()
    attractors = tuple(
        precision.attractor.pack(np.full(signature.ATTRACTOR_SIZE, grey, np.float32))
        for grey in (START, GOAL)
    )
    embedding = precision.embedding.pack(np.zeros(signature.EMBEDDING_SIZE, np.float32))
    segments = (Segment(embedding, 40),)
    period = GreyNetworks.network_period
    route = Route(GreyNetworks.model_id, MODEL_CAMERA, period, precision, attractors, segments)
    return Behavior(GreyNetworks(), route, 0)


def image(grey):
    return np.full((64, 64, 3), round(255 * grey), np.uint8)


def frames(behavior, greys):
    """How many frames generator and encoder have seen after each."""
    seen = [behavior.tick(image(grey)) for grey in greys]
    assert behavior.sight.state == seen[-1]
    return seen


def test_every_frame_is_the_first_while_the_start_comes_nearer(behavior):
    assert frames(behavior, (0.3, 0.4, 0.48, 0.54, 0.6)) == [1, 1, 1, 2, 3]


def test_robot_past_the_start_begins_at_once(behavior):
    assert frames(behavior, (0.55, 0.6, 0.65)) == [1, 2, 3]


def test_likeness_to_the_start_later_on_begins_nothing_anew(behavior):
    assert frames(behavior, (0.55, 0.6, 0.5, 0.5)) == [1, 2, 3, 4]


def test_behavior_that_was_joined_midway_goes_on(behavior):
    networks = GreyNetworks()
    sight = None
    for grey in (0.3, 0.35):
        sight = Sight.of(networks, image(grey), sight)
        behavior.follow(sight)
    assert frames(behavior, (0.4, 0.45)) == [3, 4]
