"""Certificates and access rules of a link: what is refused before a session is opened."""

import json
import logging
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cbe.access import AccessConfig
from cbe.errors import ConfigError
from cbe.linkconfig import LOOPBACK_TLS, LinkConfig
from cbe.tls import CA, CERTIFICATE, KEY, TlsConfig
from cbe.topics import CMD_VEL, KeyStyle, key_expression
from cbe_runtime.keys import AUTHORITY, Authority

DEADLINE_S = 15.0
ACCESS = AccessConfig(drive=("runtime",), call=("operator", "runtime"), read=("recorder",))


@pytest.fixture(scope="module")
def issued(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of a robot, that others may connect to, and of a runtime."""
    folder = tmp_path_factory.mktemp("keys")
    Authority(folder).issue("robot", ("127.0.0.1", "robot.local"))
    Authority(folder).issue("runtime")
    return folder


@pytest.fixture
def keys(issued: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    for folder in issued.iterdir():
        (tmp_path / folder.name).mkdir()
        for path in folder.iterdir():
            copy = tmp_path / folder.name / path.name
            copy.write_bytes(path.read_bytes())
            copy.chmod(0o600)
    return tmp_path


def check(folder: Path, listens: bool = False) -> None:
    TlsConfig.of_folder(folder).check(listens=listens, connects=not listens)


def test_issued_certificates_pass_for_what_they_were_made_for(keys: Path) -> None:
    check(keys / "robot", listens=True)
    check(keys / "robot")
    check(keys / "runtime")


def test_certificate_without_a_host_cannot_be_listened_with(keys: Path) -> None:
    with pytest.raises(ConfigError, match="purpose"):
        check(keys / "runtime", listens=True)


@pytest.mark.parametrize("file", [CA, CERTIFICATE, KEY])
def test_missing_file_is_named(keys: Path, file: str) -> None:
    (keys / "runtime" / file).unlink()
    with pytest.raises(ConfigError, match=f"runtime/{file}.*No such file"):
        check(keys / "runtime")


def test_missing_folder_is_named(keys: Path) -> None:
    with pytest.raises(ConfigError, match="nobody; make the certificates"):
        TlsConfig.of_folder(keys / "nobody")


@pytest.mark.parametrize("file", [CA, CERTIFICATE, KEY])
@pytest.mark.parametrize("content", [b"", b"junk", b"\0\xff" * 5000])
def test_file_that_is_no_pem_is_named(keys: Path, file: str, content: bytes) -> None:
    (keys / "runtime" / file).write_bytes(content)
    with pytest.raises(ConfigError, match=f"runtime/{file}"):
        check(keys / "runtime")


def test_key_of_another_certificate_is_refused(keys: Path) -> None:
    (keys / "robot" / KEY).replace(keys / "runtime" / KEY)
    with pytest.raises(ConfigError, match="is not that of"):
        check(keys / "runtime")


def test_encrypted_key_is_refused_without_asking_for_its_password(keys: Path) -> None:
    plain, encrypted = keys / "runtime" / KEY, keys / "runtime" / "encrypted.pem"
    subprocess.run(
        ("openssl", "pkey", "-aes256", "-passout", "pass:x", "-in", plain, "-out", encrypted),
        check=True,
    )
    encrypted.replace(plain)
    with pytest.raises(ConfigError, match="no unencrypted PEM pair"):
        check(keys / "runtime")


def test_key_that_every_user_can_read_is_refused(keys: Path) -> None:
    (keys / "runtime" / KEY).chmod(0o604)
    with pytest.raises(ConfigError, match="chmod 600"):
        check(keys / "runtime")


def test_certificate_of_another_authority_is_refused(keys: Path, tmp_path: Path) -> None:
    Authority(tmp_path / "other").issue("runtime")
    (tmp_path / "other" / "runtime" / CA).replace(keys / "runtime" / CA)
    with pytest.raises(ConfigError, match="does not pass with the authority"):
        check(keys / "runtime")


def test_certificate_in_the_place_of_the_authority_is_refused(keys: Path) -> None:
    ca = keys / "runtime" / CA
    ca.write_bytes((keys / "runtime" / CERTIFICATE).read_bytes())
    with pytest.raises(ConfigError, match="is no authority's certificate"):
        check(keys / "runtime")


def test_expired_certificate_is_refused(keys: Path, tmp_path: Path) -> None:
    runtime, authority, request = keys / "runtime", keys / AUTHORITY, tmp_path / "request"
    for command in (
        f"req -new -key {runtime / KEY} -subj /CN=runtime -out {request}",
        # Valid for the second that it is made in.
        f"x509 -req -days 0 -in {request} -CA {authority / CA} -CAkey {authority / KEY} "
        f"-set_serial 7 -out {runtime / CERTIFICATE}",
    ):
        subprocess.run(("openssl", *command.split()), check=True, capture_output=True)

    def refusal() -> str:
        try:
            check(runtime)
        except ConfigError as error:
            return str(error)
        return ""

    deadline = time.monotonic() + DEADLINE_S
    while not (found := refusal()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert "expired" in found
    assert str(runtime / CERTIFICATE) in found


def test_certificate_about_to_expire_is_warned_of(
    keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Authority(keys).issue("runtime", days=3, renew=True)
    check(keys / "runtime")
    assert "expires on" in caplog.text


def test_half_a_pair_is_refused() -> None:
    with pytest.raises(ConfigError, match="together with its key"):
        TlsConfig(Path(CA), certificate=Path(CERTIFICATE))
    with pytest.raises(ConfigError, match="mutual TLS needs"):
        TlsConfig(Path(CA))


def test_one_way_client_needs_the_authority_alone(keys: Path) -> None:
    for file in (CERTIFICATE, KEY):
        (keys / "runtime" / file).unlink()
    tls = TlsConfig.of_folder(keys / "runtime", mutual=False)
    tls.check(listens=False, connects=True)
    with pytest.raises(ConfigError, match="listens by TLS needs a certificate"):
        tls.check(listens=True, connects=False)


@pytest.mark.parametrize(
    "bad",
    [
        {"connect": ("tcp/127.0.0.1:7447",)},
        {"connect": ("ws/127.0.0.1:7447",)},
        {"connect": ("tls/127.0.0.1:7447#verify_name_on_connect=false",)},
        {"mode": "router", "connect": (), "listen": ("tls/127.0.0.1:1#enable_mtls=false",)},
        {"mode": "router", "connect": (), "listen": (LOOPBACK_TLS, "tcp/0.0.0.0:7448")},
        {"access": ACCESS},  # on a process that listens nowhere
    ],
    ids=repr,
)
def test_configuration_that_would_weaken_tls_is_refused(issued: Path, bad: dict[str, Any]) -> None:
    tls = TlsConfig.of_folder(issued / "robot")
    with pytest.raises(ConfigError):
        LinkConfig(**{"connect": (LOOPBACK_TLS,), "tls": tls, **bad})


def test_tls_endpoint_may_name_an_interface(issued: Path) -> None:
    tls = TlsConfig.of_folder(issued / "robot")
    LinkConfig(connect=("tls/robot.local:7447#iface=eth0",), tls=tls)


def test_tls_endpoint_without_certificates_is_refused() -> None:
    with pytest.raises(ConfigError, match="--keys"):
        LinkConfig(connect=(LOOPBACK_TLS,))


@pytest.mark.parametrize("mutual", [None, False])
def test_access_rules_without_mutual_tls_are_refused(issued: Path, mutual: bool | None) -> None:
    tls = None if mutual is None else TlsConfig.of_folder(issued / "robot", mutual=mutual)
    with pytest.raises(ConfigError, match="mutual TLS"):
        LinkConfig.hub(tls=tls, access=ACCESS)


@pytest.mark.parametrize("names", [(), ("a b",), ("*",), ("",), ("../x",)])
def test_names_no_certificate_can_bear_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError):
        AccessConfig(drive=names)


def test_hub_listens_on_loopback_unless_told_otherwise(issued: Path) -> None:
    hub = LinkConfig.hub(tls=TlsConfig.of_folder(issued / "robot"))
    assert hub.listen == (LOOPBACK_TLS,)
    assert hub.exposed == LinkConfig.hub().exposed == ()


@pytest.mark.parametrize(
    ("endpoint", "mutual", "warns"),
    [
        ("tcp/0.0.0.0:7447", None, True),
        ("tcp/127.evil.example:7447", None, True),
        ("tcp/127.0.0.1:7447", None, False),
        ("tls/0.0.0.0:7447", False, True),
        ("tls/0.0.0.0:7447", True, False),
    ],
)
def test_listening_to_strangers_beyond_this_machine_is_warned_of(
    issued: Path,
    caplog: pytest.LogCaptureFixture,
    endpoint: str,
    mutual: bool | None,
    warns: bool,
) -> None:
    tls = None if mutual is None else TlsConfig.of_folder(issued / "robot", mutual=mutual)
    with caplog.at_level(logging.WARNING):
        LinkConfig.hub(endpoint, tls=tls).check()
    assert ("ANYONE" in caplog.text) is warns
    assert (endpoint in caplog.text) is warns


@pytest.mark.parametrize("style", KeyStyle)
def test_only_drivers_are_granted_a_rule_that_holds_cmd_vel(issued: Path, style: KeyStyle) -> None:
    tls = TlsConfig.of_folder(issued / "robot")
    hub = LinkConfig.hub(tls=tls, access=replace(ACCESS, sense=("camera",)), style=style, domain=3)
    rules = json.loads(hub.zenoh_json5()["access_control"])
    holding = {
        rule["id"]
        for rule in rules["rules"]
        if "put" in rule["messages"] and "ingress" in rule["flows"]
        for key in rule["key_exprs"]
        if _holds(key, key_expression(CMD_VEL, style, 3))
    }
    granted = {
        policy["subjects"][0] for policy in rules["policies"] if holding & set(policy["rules"])
    }
    assert rules["default_permission"] == "deny"
    assert granted == {"runtime"}


def _holds(pattern: str, key: str) -> bool:
    """Whether a pattern whose only wildcards are `*` and `**` chunks includes a key."""
    ours, theirs = pattern.split("/"), key.split("/")
    if ours == ["**"]:
        return True
    assert "**" not in ours
    return len(ours) == len(theirs) and all(
        one in ("*", other) for one, other in zip(ours, theirs, strict=True)
    )
