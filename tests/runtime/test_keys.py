"""Certificates are made whole, private and only for what was asked."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cbe.errors import ConfigError
from cbe.tls import CERTIFICATE, KEY, TlsConfig
from cbe_runtime.cli import keys_main
from cbe_runtime.keys import AUTHORITY, Authority


@pytest.fixture
def loose_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


def test_private_keys_are_their_owners_alone(tmp_path: Path, loose_umask: None) -> None:
    made = Authority(tmp_path / "keys").issue("runtime")
    for path in (made, *made.iterdir(), tmp_path / "keys" / AUTHORITY / KEY):
        assert path.stat().st_mode & 0o077 == 0, path


@pytest.mark.parametrize(
    "wrong",
    [
        {"name": "a/b"},
        {"name": AUTHORITY},
        {"name": "-subj"},
        {"name": "x", "hosts": ("a b",)},
        {"name": "x", "hosts": ("a, DNS:b",)},
        {"name": "x", "days": 0},
        {"name": "x", "days": 10**6},
    ],
    ids=repr,
)
def test_wrong_requests_for_a_certificate_are_refused(
    tmp_path: Path, wrong: dict[str, Any]
) -> None:
    with pytest.raises(ConfigError):
        Authority(tmp_path).issue(**wrong)
    assert list(tmp_path.iterdir()) == []


def test_existing_certificate_is_replaced_only_on_request(tmp_path: Path) -> None:
    certificate = Authority(tmp_path).issue("runtime") / CERTIFICATE
    before = certificate.read_bytes()
    with pytest.raises(ConfigError, match="--renew"):
        Authority(tmp_path).issue("runtime")
    assert certificate.read_bytes() == before
    renewed = Authority(tmp_path).issue("runtime", renew=True)
    assert certificate.read_bytes() != before
    TlsConfig.of_folder(renewed).check(listens=False, connects=True)


def test_command_makes_a_folder_for_each_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    assert keys_main([str(folder), "robot", "--host", "127.0.0.1"]) == 0
    assert keys_main([str(folder), "runtime", "operator"]) == 0
    assert capsys.readouterr().out.split() == [
        str(folder / name) for name in ("robot", "runtime", "operator")
    ]
    TlsConfig.of_folder(folder / "robot").check(listens=True, connects=False)
    assert keys_main([str(folder), "runtime"]) == 2
    assert "--renew" in capsys.readouterr().err


def test_machine_without_openssl_is_told_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="no openssl"):
        Authority(tmp_path / "keys").issue("runtime")
