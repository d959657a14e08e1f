"""A TLS handshake with oneself: finds what every peer would refuse, and says why.

Zenoh only says that nobody answered.
"""

from __future__ import annotations

import logging
import ssl
import time
from typing import TYPE_CHECKING, Any

from cbe.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from cbe.tls import TlsConfig

logger = logging.getLogger(__name__)

SOON_S = 14 * 24 * 3600
"""A certificate that expires within this time is warned of."""

_OTHERS = 0o007  # a file's permissions for everyone else


def rehearse(tls: TlsConfig, listens: bool, connects: bool) -> None:
    """Check a link's files and shake hands in each part that it will play.

    Raises:
        ConfigError: see `TlsConfig.check`.
    """
    _readable(tls.ca)
    _check_authority(tls.ca)
    if tls.certificate is None or tls.key is None:
        if listens:
            raise ConfigError("a link that listens by TLS needs a certificate and its key")
        return
    _readable(tls.certificate)
    _readable(tls.key)
    if tls.key.stat().st_mode & _OTHERS:
        raise ConfigError(f"every user may use the key {tls.key}; run chmod 600 {tls.key}")
    if listens:
        shown = _shown(tls, tls.certificate, as_server=True)
        if tls.verify_name and not shown.get("subjectAltName"):
            raise ConfigError(
                f"the certificate {tls.certificate} names no host, so nobody could check where it "
                "connects; make it with cbe-keys --host"
            )
        _warn_of_expiry(tls.certificate, shown["notAfter"])
    if connects and tls.mutual:
        shown = _shown(tls, tls.certificate, as_server=False)
        _warn_of_expiry(tls.certificate, shown["notAfter"])


def _shown(tls: TlsConfig, certificate: Path, as_server: bool) -> dict[str, Any]:
    """Our certificate's content once a peer with the same authority has accepted it."""
    server = _context(ssl.PROTOCOL_TLS_SERVER, tls.ca)
    client = _context(ssl.PROTOCOL_TLS_CLIENT, tls.ca)
    shows, judges = (server, client) if as_server else (client, server)
    shows.verify_mode, judges.verify_mode = ssl.CERT_NONE, ssl.CERT_REQUIRED
    for context in (server, client):
        _load_pair(context, certificate, tls.key)
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        client.wrap_bio(to_client, to_server),
        server.wrap_bio(to_server, to_client, server_side=True),
    )
    waiting = list(ends)
    try:
        while waiting:
            waiting = [end for end in waiting if not _done(end)]
    except ssl.SSLError as error:
        reason = getattr(error, "verify_message", None) or error.reason
        raise ConfigError(
            f"the certificate {certificate} does not pass with the authority {tls.ca}: {reason}; "
            f"make a new one with cbe-keys{' --host' if as_server else ''}, or check the clock"
        ) from error
    return ends[0 if as_server else 1].getpeercert() or {}


def _load_pair(context: ssl.SSLContext, certificate: Path, key: Path | None) -> None:
    try:
        # Without a password at hand OpenSSL would ask for one on the terminal.
        context.load_cert_chain(certificate, key, password=lambda: "")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise ConfigError(
                f"the key {key} is not that of {certificate}; keep the files of one process "
                "together"
            ) from error
        raise ConfigError(
            f"the certificate {certificate} and the key {key} are no unencrypted PEM pair: "
            f"{error.reason or error}"
        ) from error


def _context(protocol: int, ca: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.check_hostname = False
    try:
        context.load_verify_locations(ca)
    except ssl.SSLError as error:
        raise ConfigError(f"{ca} holds no certificate in PEM form: {error.reason}") from error
    return context


def _readable(path: Path) -> None:
    try:
        path.open("rb").close()
    except OSError as error:
        raise ConfigError(
            f"cannot read the TLS file {path}: {error.strerror}; make it with cbe-keys"
        ) from error


def _check_authority(path: Path) -> None:
    found: list[dict[str, Any]] = _context(ssl.PROTOCOL_TLS_CLIENT, path).get_ca_certs()
    if not found:
        raise ConfigError(f"{path} is no authority's certificate; expected the CA's own")
    for authority in found:
        if ssl.cert_time_to_seconds(authority["notAfter"]) < time.time():
            raise ConfigError(
                f"the authority {path} expired on {authority['notAfter']}; make a new one and "
                "new certificates with cbe-keys, or check the clock"
            )


def _warn_of_expiry(path: Path, not_after: str) -> None:
    if ssl.cert_time_to_seconds(not_after) < time.time() + SOON_S:
        logger.warning("the certificate %s expires on %s; the link ends then", path, not_after)


def _done(end: ssl.SSLObject) -> bool:
    """Go on with a handshake; whether it is over."""
    try:
        end.do_handshake()
    except ssl.SSLWantReadError:
        return False
    return True
