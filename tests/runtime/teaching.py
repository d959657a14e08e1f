"""A process that teaches one route after another into the same file until it is killed.

Run as a script it forks such a process for each path on its stdin, prints its id, and `dead` once
it has been killed: so what it imports is paid for once.
"""

import os
import sys
from pathlib import Path

import numpy as np

from cbe import signature
from cbe.camera import MODEL_CAMERA
from cbe_runtime import routefile
from cbe_runtime.teach import Teacher


class ArithmeticNetworks:
    """Stands for `Networks`: what it puts out follows from the image's first pixel."""

    model_id = "00112233445566aa"
    network_period = 2
    segment_steps = 40

    def encoder_state(self):
        return None

    def encode(self, image, state):
        del state
        value = image[0, 0, 0] / 255.0
        return value, np.full(signature.EMBEDDING_SIZE, value, np.float32), None

    def attract(self, features):
        return np.full(signature.ATTRACTOR_SIZE, features, np.float32)


def taught(number):
    """The route of that number: always the same, and unlike all others."""
    teacher = Teacher(ArithmeticNetworks(), MODEL_CAMERA)
    for step in range(100):
        teacher.feed(np.full((64, 64, 3), (number + step) % 256, np.uint8))
    return teacher.finish({"number": str(number)})


def teach_for_ever(path):
    number = 0
    while True:
        routefile.save(taught(number), path)
        number += 1


def say(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main():
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            teach_for_ever(Path(line.strip()))
        say(str(child))
        os.waitpid(child, 0)
        say("dead")


if __name__ == "__main__":
    main()
