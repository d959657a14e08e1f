"""Settings that every test needs before numpy and matplotlib are imported."""

import os
from pathlib import Path

# Two workers share the cores; a thread pool in each would only make them wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from hypothesis import settings

# A slow machine is no failure, and the same commit gives the same verdict every time.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")

SIL = Path(__file__).parent / "sil"


# First, so that xdist sees the group when it hands out tests.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep tests that start processes on one worker, so that they do not starve each other."""
    for item in items:
        if SIL in item.path.parents:
            item.add_marker("loopback")
        if item.get_closest_marker("loopback"):
            item.add_marker(pytest.mark.xdist_group("loopback"))
