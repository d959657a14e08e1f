"""Makes the certificates of a robot's processes: one authority, one folder for each name.

It runs `openssl` (1.1.1 or newer) with a configuration of its own, so that no setting of the
machine changes what comes out. docs/security.md shows the same commands for the shell.
"""

from __future__ import annotations

import ipaddress
import secrets
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from cbe.access import NAME
from cbe.errors import ConfigError
from cbe.tls import CA, CERTIFICATE, KEY

AUTHORITY = "authority"
"""Folder of the authority, whose key never needs to leave the machine it was made on."""

AUTHORITY_DAYS = 3650
DAYS = 365
TIMEOUT_S = 60.0  # an openssl that asks for something would never end

_CONFIG = "[req]\ndistinguished_name = name\n[name]\n"
_KEY_KIND = ("-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256")


@dataclass(frozen=True, slots=True)
class Authority:
    """Signs certificates; made in `folder` the first time one is asked for."""

    folder: Path

    def issue(
        self, name: str, hosts: tuple[str, ...] = (), days: int = DAYS, renew: bool = False
    ) -> Path:
        """A process's folder with ca.pem, cert.pem and key.pem, all for its owner's eyes only.

        Only a certificate with `hosts`, names or addresses, may be listened with: a stolen one
        of an operator cannot pose as the robot.

        Raises:
            ConfigError: a malformed name, host or number of days, a folder that exists without
                `renew`, or openssl is missing or fails.
        """
        if not NAME.fullmatch(name) or name == AUTHORITY:
            raise ConfigError(f"{name!r} is no name for a certificate; letters, digits, _.- only")
        if not 1 <= days <= AUTHORITY_DAYS:
            raise ConfigError(f"a certificate lasts 1 to {AUTHORITY_DAYS} days; found {days}")
        target = self.folder / name
        if target.exists() and not renew:
            raise ConfigError(f"{target} exists; ask for --renew to replace it")
        uses, alternatives = "clientAuth", [_alternative(host) for host in hosts]
        extensions = [
            "basicConstraints = critical, CA:FALSE",
            "keyUsage = critical, digitalSignature",
            "subjectKeyIdentifier = hash",
            "authorityKeyIdentifier = keyid",
        ]
        if alternatives:
            uses += ", serverAuth"
            extensions.append(f"subjectAltName = {', '.join(alternatives)}")
        extensions.append(f"extendedKeyUsage = {uses}")
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            authority = self._made()
            signer = ("-CA", str(authority / CA), "-CAkey", str(authority / KEY))
            serial = ("-set_serial", f"0x{1 + secrets.randbits(63):x}")
            with tempfile.TemporaryDirectory(prefix=".", dir=self.folder) as scratch:
                new = Path(scratch) / "new"
                _certify(new, name, CERTIFICATE, days, extensions, (*signer, *serial))
                shutil.copy(authority / CA, new / CA)
                if target.exists():
                    target.rename(Path(scratch) / "old")
                new.rename(target)
        except OSError as error:
            raise ConfigError(f"cannot write to {self.folder}: {error.strerror}") from error
        return target

    def _made(self) -> Path:
        """The authority's folder."""
        target = self.folder / AUTHORITY
        if not target.exists():
            extensions = [
                "basicConstraints = critical, CA:TRUE, pathlen:0",
                "keyUsage = critical, keyCertSign, cRLSign",
                "subjectKeyIdentifier = hash",
            ]
            with tempfile.TemporaryDirectory(prefix=".", dir=self.folder) as scratch:
                new = Path(scratch) / "new"
                own = ("-signkey", str(new / KEY))
                _certify(new, "cbe authority", CA, AUTHORITY_DAYS, extensions, own)
                new.rename(target)
        return target


def _certify(
    folder: Path, name: str, file: str, days: int, extensions: list[str], signer: tuple[str, ...]
) -> None:
    """Make `folder` with key.pem and a certificate of it."""
    folder.mkdir(mode=0o700)
    config, wanted, request = (folder / each for each in ("config", "extensions", "request"))
    config.write_text(_CONFIG)
    wanted.write_text("\n".join(extensions) + "\n")
    key = str(folder / KEY)
    _openssl("genpkey", *_KEY_KIND, "-out", key)
    subject = ("-subj", f"/CN={name}")
    _openssl("req", "-new", "-config", str(config), "-key", key, *subject, "-out", str(request))
    _openssl(
        "x509", "-req", "-in", str(request), "-days", str(days), "-sha256", *signer,
        "-extfile", str(wanted), "-out", str(folder / file),
    )  # fmt: skip
    for path in (config, wanted, request):
        path.unlink()


def _openssl(*arguments: str) -> None:
    try:
        subprocess.run(
            ("openssl", *arguments), check=True, capture_output=True, stdin=subprocess.DEVNULL,
            umask=0o077, timeout=TIMEOUT_S,
        )  # fmt: skip
    except FileNotFoundError as error:
        raise ConfigError("there is no openssl on this machine; install it (apt)") from error
    except subprocess.TimeoutExpired as error:
        raise ConfigError(f"openssl {arguments[0]} did not end in {TIMEOUT_S:g} s") from error
    except subprocess.CalledProcessError as error:
        reason = error.stderr.decode(errors="replace").strip()
        raise ConfigError(f"openssl {arguments[0]} failed: {reason}") from error


def _alternative(host: str) -> str:
    try:
        return f"IP:{ipaddress.ip_address(host)}"
    except ValueError:
        if not NAME.fullmatch(host):
            raise ConfigError(f"{host!r} is neither a host's name nor an IP address") from None
        return f"DNS:{host}"
