"""Single behaviors, closed loop (paper, Sec. IV-B)."""

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cbe_bench.evaluation import Evaluation, RunConfig, evaluate
from cbe_bench.route import Teaching
from cbe_runtime.networks import Networks
from cbe_runtime.route import Precision, Route

USUAL = Precision()


def run(config: RunConfig, label: str = "episodes", precision: Precision = USUAL) -> Evaluation:
    """Drive all episodes, each drive taught as one behavior; raises CbeError as `evaluate`."""
    done = evaluate(config, functools.partial(teach, precision=precision), label)
    done.summary["config"]["precision"] = precision.attractor.value
    return done


def teach(
    networks: Networks, views: Sequence[NDArray[np.uint8]], precision: Precision = USUAL
) -> Route:
    """The route of a drive's views (64, 64, 3), one a step, as a single behavior."""
    # One more than the drive's steps, for the teacher rounds down to whole network periods.
    return Teaching(len(views), precision)(networks, views)
