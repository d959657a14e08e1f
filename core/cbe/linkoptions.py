"""Command-line options for a link's certificates and access rules, the same in every command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cbe.access import AccessConfig
from cbe.errors import ConfigError
from cbe.tls import TlsConfig

if TYPE_CHECKING:
    import argparse


def add_security(parser: argparse.ArgumentParser) -> None:
    """--keys, --one-way-tls, --any-host, --allow-drive, --allow-sense, --allow-call, --allow-read.

    See docs/security.md.
    """
    group = parser.add_argument_group("security of the link")
    group.add_argument(
        "--keys",
        type=Path,
        metavar="DIR",
        help="this process's folder of ca.pem, cert.pem and key.pem, as cbe-keys makes it; "
        "endpoints are then tls/... or quic/...",
    )
    group.add_argument(
        "--one-way-tls",
        action="store_true",
        help="ask no certificate of those who connect: encrypted, but anyone may come",
    )
    group.add_argument(
        "--any-host",
        action="store_true",
        help="connect to any certificate of the authority, whatever host it names",
    )
    for action, meaning in (
        ("drive", "publish cmd_vel (the runtime's)"),
        ("sense", "publish camera, scan and odom (a robot's that connects to this process)"),
        ("call", "call start, stop, ... (an operator's)"),
        ("read", "only listen (a recorder's)"),
    ):
        group.add_argument(
            f"--allow-{action}",
            metavar="NAME",
            action="append",
            help=f"certificate that may {meaning}; may be repeated. Any --allow-... shuts out "
            "everyone else",
        )


def security(options: argparse.Namespace) -> dict[str, Any]:
    """LinkConfig's `tls` and `access` as these options say; empty without them.

    Raises:
        ConfigError: no such folder, or options that need --keys.
    """
    allowed = {
        action: tuple(getattr(options, f"allow_{action}") or ())
        for action in ("drive", "sense", "call", "read")
    }
    if options.keys is None:
        if any(allowed.values()) or options.one_way_tls or options.any_host:
            raise ConfigError("--one-way-tls, --any-host and --allow-... need --keys as well")
        return {}
    tls = TlsConfig.of_folder(options.keys, not options.one_way_tls, not options.any_host)
    return {"tls": tls, "access": AccessConfig(**allowed) if any(allowed.values()) else None}
