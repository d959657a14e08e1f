from dataclasses import replace

import numpy as np
import pytest

from cbe.errors import ConfigError, RouteError
from cbe_runtime import budget, routefile
from cbe_runtime.budget import FINEST_FIRST
from cbe_runtime.pathshape import PathShape
from cbe_runtime.route import Precision, Segment

LONGEST = 40


@pytest.fixture
def drive(route):
    """Ten segments of 40 steps: 20 m at full speed."""
    segment = Segment(route.segments[0].embedding, LONGEST)
    return replace(route, attractors=(route.attractors[0],) * 11, segments=(segment,) * 10)


@pytest.mark.parametrize(("text", "value"), [("100B/m", 100.0), ("62.5 B/m", 62.5)])
def test_budget_is_bytes_a_metre(text, value):
    assert budget.parse(text) == value


@pytest.mark.parametrize("text", ["", "100", "0B/m", "-3B/m", "1e9B/m", "nanB/m", "100kB/m"])
def test_what_is_no_budget_is_refused(text):
    with pytest.raises(ConfigError, match="100B/m"):
        budget.parse(text)


@pytest.mark.parametrize("bytes_per_m", [160.0, 200.0, 250.0, 300.0, 400.0, 600.0])
def test_planned_route_keeps_to_the_budget_and_to_the_longest_segment(drive, bytes_per_m):
    plan = budget.plan(drive, 20.0, bytes_per_m, LONGEST)
    assert plan.size_bytes <= bytes_per_m * 20.0
    assert LONGEST / 2 <= plan.segment_steps <= LONGEST


def test_planned_size_is_that_of_the_file(drive):
    plan = budget.plan(drive, 20.0, 1_000.0, LONGEST)
    segments = -(-drive.steps // plan.segment_steps)
    size = plan.precision.embedding.size_bytes
    taught = replace(
        drive,
        precision=plan.precision,
        attractors=(bytes(plan.precision.attractor.size_bytes),) * (segments + 1),
        segments=(Segment(bytes(size), plan.segment_steps),) * segments,
    )
    assert len(routefile.dump(taught)) == plan.size_bytes


def test_more_budget_is_finer_or_shorter(drive):
    plans = [budget.plan(drive, 20.0, each, LONGEST) for each in (145.0, 200.0, 300.0, 600.0)]
    fineness = [FINEST_FIRST.index(each.precision) for each in plans]
    assert fineness == sorted(fineness, reverse=True)
    assert plans[0].precision == FINEST_FIRST[-1]
    assert plans[-1].precision == Precision()
    assert plans[-1].segment_steps == LONGEST / 2


def test_budget_that_nothing_fits_is_refused_with_the_figures(drive):
    with pytest.raises(RouteError, match=r"50 B/m are 1000 bytes .* 20.0 m, but 10 segments"):
        budget.plan(drive, 20.0, 50.0, LONGEST)


def test_length_is_read_off_the_embeddings_or_else_off_the_time(drive, tmp_path, shape_writer):
    path_m = np.stack([np.linspace(0.125, 1.0, 8), np.zeros(8)], axis=1)
    shape = PathShape.load(shape_writer(tmp_path, path_m))
    assert budget.length_m(drive, shape) == (pytest.approx(10.0, rel=1e-5), "by embeddings")
    assert budget.length_m(drive, None)[0] == pytest.approx(20.0)
