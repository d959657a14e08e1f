"""The distribution holds what it promises: its commands, and every library its rooms import."""

import ast
import importlib
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
ROOMS = {
    Path(package).name: ROOT / package
    for package in PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
}
# The extras each room may count on; `bench` is installed beside `train` by `make install`.
EXTRAS = {
    "cbe": [],
    "cbe_runtime": ["view"],
    "cbe_hil_sim": ["sim"],
    "cbe_training": ["sim", "train"],
    "cbe_export": ["sim", "train"],
    "cbe_bench": ["sim", "train", "bench"],
}


def imported(room: Path) -> set[str]:
    """Top-level modules that a room's files import, inside functions too."""
    names: set[str] = set()
    for path in room.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names.update(alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.partition(".")[0])
    return names - set(sys.stdlib_module_names) - set(ROOMS)


def declared(room: str) -> set[str]:
    """Distributions that pyproject.toml names for a room."""
    extras = PROJECT["optional-dependencies"]
    lines = [*PROJECT["dependencies"], *(line for name in EXTRAS[room] for line in extras[name])]
    return {re.split(r"[^\w-]", line)[0] for line in lines}


@pytest.mark.parametrize("entry", PROJECT["scripts"].values(), ids=PROJECT["scripts"])
def test_command_is_callable(entry: str) -> None:
    module, function = entry.split(":")
    assert callable(getattr(importlib.import_module(module), function))


@pytest.mark.parametrize("room", ROOMS)
def test_room_imports_only_declared_libraries(room: str) -> None:
    distributions = metadata.packages_distributions()
    undeclared = {
        module
        for module in imported(ROOMS[room])
        if declared(room).isdisjoint(name.lower() for name in distributions.get(module, ()))
    }
    assert not undeclared
