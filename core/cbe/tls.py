"""The certificates a link proves itself with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cbe.errors import ConfigError

CA, CERTIFICATE, KEY = "ca.pem", "cert.pem", "key.pem"
"""The files of a process's folder, as `cbe-keys` makes it."""


@dataclass(frozen=True, slots=True)
class TlsConfig:
    """PEM files of one process, and what it demands of the other side.

    `mutual`: who connects shows a certificate too. `verify_name`: who is connected to must be
    certified for the host in the endpoint. A process that only connects, one-way, needs the
    authority's certificate alone.
    """

    ca: Path
    certificate: Path | None = None
    key: Path | None = None
    mutual: bool = True
    verify_name: bool = True

    def __post_init__(self) -> None:
        """Refuse half a pair."""
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("TLS needs a certificate together with its key, or neither")
        if self.mutual and self.certificate is None:
            raise ConfigError("mutual TLS needs a certificate and its key on either side")

    @classmethod
    def of_folder(cls, folder: Path, mutual: bool = True, verify_name: bool = True) -> TlsConfig:
        """The folder's ca.pem, cert.pem and key.pem; the last two may lack without `mutual`.

        Raises:
            ConfigError: there is no such folder.
        """
        try:
            found = folder.is_dir()
        except OSError:  # a name too long
            found = False
        if not found:
            raise ConfigError(f"no folder {folder}; make the certificates in it with cbe-keys")
        certificate: Path | None = folder / CERTIFICATE
        key: Path | None = folder / KEY
        if not mutual and not any(path.exists() for path in (folder / CERTIFICATE, folder / KEY)):
            certificate = key = None
        return cls(folder / CA, certificate, key, mutual, verify_name)

    def check(self, listens: bool, connects: bool) -> None:
        """Find here, before a session is opened, what every peer would refuse.

        Raises:
            ConfigError: a file is missing, unreadable, expired, not of the authority or not fit
                for its use, the key is another certificate's or open to all users of the machine.
        """
        # Without certificates a link spares OpenSSL's 4.5 MiB and 20 ms.
        from cbe.rehearsal import rehearse

        rehearse(self, listens, connects)

    def zenoh(self) -> dict[str, Any]:
        """Zenoh's `transport/link/tls`."""
        certificate = None if self.certificate is None else str(self.certificate.absolute())
        key = None if self.key is None else str(self.key.absolute())
        return {
            "root_ca_certificate": str(self.ca.absolute()),
            "enable_mtls": self.mutual,
            "verify_name_on_connect": self.verify_name,
            # A link does not outlive the certificate it was opened with.
            "close_link_on_expiration": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        }
