"""Whatever happens while a route is taught, its file is the old one or the new one, whole."""

import importlib.util
import os
import random
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from cbe.errors import RouteError
from cbe_runtime import cli, routefile

KILLS = int(os.environ.get("CBE_KILLS", "20"))
SEED = int(os.environ.get("CBE_KILL_SEED", "0"))
SCRIPT = Path(__file__).with_name("teaching.py")
DEADLINE_S = 60.0


@pytest.fixture(scope="module")
def taught():
    spec = importlib.util.spec_from_file_location("teaching", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.taught


@pytest.fixture
def teachers():
    """A script that starts a teaching process for each line written to it."""
    script = subprocess.Popen(
        [sys.executable, str(SCRIPT)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    yield script
    script.stdin.close()
    script.stdout.close()
    script.wait()


@pytest.mark.timeout(3600)
def test_killed_teacher_leaves_a_whole_route(teachers, taught, tmp_path):
    chance, numbers = random.Random(SEED), []
    for kill in range(KILLS):
        path = tmp_path / str(kill) / "route.msgpack"
        path.parent.mkdir()
        routefile.save(taught(1000), path)
        teachers.stdin.write(f"{path}\n")
        teachers.stdin.flush()
        teacher = int(teachers.stdout.readline())
        if kill % 2:  # half of them at once, the others among later routes
            give_up_s = time.monotonic() + DEADLINE_S
            while routefile.load(path).tags["number"] == "1000":
                assert time.monotonic() < give_up_s, "the teacher never saved a route"
        time.sleep(chance.uniform(0.0, 0.05))
        os.kill(teacher, signal.SIGKILL)
        assert teachers.stdout.readline() == "dead\n"

        left = routefile.load(path)
        numbers.append(int(left.tags["number"]))
        assert routefile.dump(left) == routefile.dump(taught(numbers[-1]))
    assert min(numbers[1::2]) < 1000  # else nothing was ever taught


def test_file_size_limit_leaves_the_old_route(taught, tmp_path):
    path = tmp_path / "route.msgpack"
    routefile.save(taught(0), path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))
    try:
        with pytest.raises(RouteError, match="File too large"):
            routefile.save(taught(1), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert routefile.load(path) == taught(0)
    assert list(tmp_path.iterdir()) == [path]


@pytest.fixture
def disk(tmp_path):
    """A disk of 32 KB that can be filled and made read-only; where one may be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(*options):
        done = subprocess.run(
            ["mount", *options, str(folder)], capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            pytest.skip(f"no disk can be mounted here: {done.stderr.strip()}")

    try:
        mount("-t", "tmpfs", "-o", "size=32k", "tmpfs")
    except FileNotFoundError:
        pytest.skip("there is no mount command")
    yield folder, lambda: mount("-o", "remount,ro")
    subprocess.run(["umount", str(folder)], check=True)


def test_full_disk_leaves_the_old_route(disk, taught):
    folder, _ = disk
    path = folder / "route.msgpack"
    routefile.save(taught(0), path)
    with (folder / "ballast").open("wb", buffering=0) as ballast, suppress(OSError):
        while True:
            ballast.write(bytes(1024))
    with pytest.raises(RouteError, match="No space left"):
        routefile.save(taught(1), path)
    assert routefile.load(path) == taught(0)
    assert {each.name for each in folder.iterdir()} == {"route.msgpack", "ballast"}


def test_read_only_disk_leaves_the_old_route(disk, taught):
    folder, make_read_only = disk
    path = folder / "route.msgpack"
    routefile.save(taught(0), path)
    make_read_only()
    with pytest.raises(RouteError, match="Read-only"):
        routefile.save(taught(1), path)
    assert routefile.load(path) == taught(0)


def test_teaching_is_refused_before_the_drive_where_nothing_can_be_written(
    tmp_path, model_folder, capsys
):
    path = tmp_path / "missing" / "route.msgpack"
    options = ["--live", "-o", str(path), "--model", str(model_folder)]
    assert cli.teach_main([*options, "--connect", "tcp/127.0.0.1:1"]) == 2
    told = capsys.readouterr().err
    assert "cannot write the route" in told
    assert "no answer" not in told  # it did not even look for the robot


def test_looking_whether_a_route_can_be_written_changes_nothing(taught, tmp_path):
    path = tmp_path / "route.msgpack"
    routefile.save(taught(0), path)
    routefile.require_writable(path)
    assert routefile.load(path) == taught(0)
    assert list(tmp_path.iterdir()) == [path]
