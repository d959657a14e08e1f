"""Reading a file or a message can never run what it holds."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("core", "runtime", "hil_sim", "training", "export", "bench", "demo")
UNPICKLERS = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "shelve", "marshal"}
FILES = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]


def unpickling(tree):
    """What in a file's syntax could unpickle."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from UNPICKLERS & {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            yield from UNPICKLERS & {(node.module or "").partition(".")[0]}
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            called = ast.unparse(node.func)
            options = {each.arg: ast.unparse(each.value) for each in node.keywords}
            if options.get("allow_pickle", "False") != "False":
                yield f"{called}(allow_pickle)"
            if called == "torch.load" and options.get("weights_only") != "True":
                yield called
            if called in ("joblib.load", "yaml.load", "np.loads"):
                yield called


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "np.load(path, allow_pickle=True)",
        "torch.load(path)",
        "joblib.load(path)",
    ],
)
def test_what_unpickles_is_recognised(source):
    assert list(unpickling(ast.parse(source)))


def test_no_room_unpickles():
    assert len(FILES) > 100
    found = {str(path): list(unpickling(ast.parse(path.read_text()))) for path in FILES}
    assert not {path: names for path, names in found.items() if names}
