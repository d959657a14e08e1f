"""Hostile inputs of every kind; `make soak` feeds many, `make test` a few."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from .harness import Report, fuzz

PROPERTY = "fuzz"


@pytest.fixture
def fuzzed(tmp_path: Path, record_property: Callable[[str, Any], None]) -> Iterator[Any]:
    """`harness.fuzz` with a folder for what escapes; its report goes to the summary."""
    logging.disable()  # a warning for each damaged file would be kept by pytest

    def run(*arguments: Any, **options: Any) -> Report:
        report = fuzz(*arguments, folder=tmp_path, **options)
        record_property(PROPERTY, str(report))
        return report

    yield run
    logging.disable(logging.NOTSET)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """One line for each kind of input."""
    lines = [
        value
        for reports in terminalreporter.stats.values()
        for report in reports
        for name, value in getattr(report, "user_properties", [])
        if name == PROPERTY and report.when == "call"
    ]
    for line in lines:
        terminalreporter.write_line(f"fuzz {line}")
