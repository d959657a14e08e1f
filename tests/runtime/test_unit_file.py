"""The systemd unit that is ready to install."""

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from cbe_runtime.scheduling import PRIORITY
from cbe_runtime.watchdog import END_S

UNIT = Path(__file__).parents[2] / "runtime" / "systemd" / "cbe-runtime.service"


@pytest.fixture(scope="module")
def service():
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str
    parser.read(UNIT)
    return parser["Service"]


def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    if not shutil.which("systemd-analyze"):
        pytest.skip("needs systemd-analyze")
    program = tmp_path / "cbe-runtime"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace("/opt/cbe/bin/cbe-runtime", str(program)))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    complaints = [line for line in done.stderr.splitlines() if UNIT.name in line]
    assert done.returncode == 0, done.stderr
    assert complaints == []


def test_unit_is_hardened_and_restarts_what_failed(service):
    expected = {
        "Type": "notify",
        "Restart": "on-failure",
        "NoNewPrivileges": "yes",
        "ProtectSystem": "strict",
        "User": "cbe",
        "CapabilityBoundingSet": "",
        "MemoryMax": "512M",
        "CPUQuota": "100%",
        "CPUSchedulingPolicy": "fifo",
        "CPUSchedulingPriority": str(PRIORITY),
    }
    assert {name: service[name] for name in expected} == expected


def test_unit_lets_the_runtimes_own_watchdog_come_first(service):
    assert float(service["WatchdogSec"]) > END_S


def test_command_of_the_unit_is_one_the_runtime_takes(service):
    import argparse

    from cbe_runtime.command_runtime import add_options

    program, *arguments = service["ExecStart"].split()
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_options(parser)
    assert Path(program).name == "cbe-runtime"
    assert re.fullmatch(r"/\S+\.toml", str(parser.parse_args(arguments).config))
