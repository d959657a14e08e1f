"""What the Zenoh link is opened with."""

import ipaddress
import json
import logging
import re
from dataclasses import dataclass
from typing import Any, Literal

from cbe.access import AccessConfig
from cbe.errors import ConfigError
from cbe.tls import TlsConfig
from cbe.topics import KeyStyle

logger = logging.getLogger(__name__)

LOOPBACK = "tcp/127.0.0.1:7447"
"""Where a robot's or simulator's hub listens unless told otherwise."""

LOOPBACK_TLS = "tls/127.0.0.1:7447"
"""The same where certificates are given."""

MAX_MESSAGE_BYTES = 2**26
MAX_DOMAIN = 232  # ROS_DOMAIN_ID's upper bound

_ENDPOINT = re.compile(r"(tcp|tls|udp|quic|ws)/(?P<host>\[[0-9a-fA-F:.]+\]|[\w.-]+):\d{1,5}(#.+)?")
# What may follow "#" beside an interface would override the settings of TLS.
_TLS_ENDPOINT = re.compile(r"(tls|quic)/[^#]+(#iface=[\w.-]+)?")
_UNIX_ENDPOINT = re.compile(r"unixsock-stream/.+")
_NAME = re.compile(r"[A-Za-z0-9_-]+")


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """Endpoints such as "tcp/127.0.0.1:7447", and how keys are built.

    One process of a group is the hub (`mode` "router", listening), the others are its clients.
    Two processes may also be peers, one listening and one connecting. Nothing is ever found by
    multicast or gossip, and nothing listens unless `listen` says where.

    With `tls`, every endpoint is "tls/..." or "quic/..."; `access` says who may do what on a link
    that listens by mutual TLS.

    Raises ConfigError for what cannot work.
    """

    mode: Literal["client", "peer", "router"] = "client"
    connect: tuple[str, ...] = (LOOPBACK,)
    listen: tuple[str, ...] = ()
    style: KeyStyle = KeyStyle.RMW_ZENOH
    domain: int = 0
    robot: str = "robot"
    open_timeout_s: float = 3.0
    tls: TlsConfig | None = None
    access: AccessConfig | None = None

    def __post_init__(self) -> None:
        """Check each field and that mode and endpoints agree."""
        if self.mode not in ("client", "peer", "router"):
            raise ConfigError(f"link mode must be client, peer or router; found {self.mode!r}")
        for endpoint in (*self.connect, *self.listen):
            if not (_ENDPOINT.fullmatch(endpoint) or _UNIX_ENDPOINT.fullmatch(endpoint)):
                raise ConfigError(
                    f"link endpoint {endpoint!r} is malformed; one looks like {LOOPBACK!r}"
                )
        if self.mode == "client" and (self.listen or not self.connect):
            raise ConfigError("a link in client mode connects to an endpoint and listens on none")
        if not (self.connect or self.listen):
            raise ConfigError("a link needs an endpoint to connect to or to listen on")
        if not 0 <= self.domain <= MAX_DOMAIN:
            raise ConfigError(f"ROS domain must be 0 to {MAX_DOMAIN}; found {self.domain}")
        if not _NAME.fullmatch(self.robot):
            raise ConfigError(f"robot name {self.robot!r} may hold letters, digits, _ and - only")
        if not 0.0 < self.open_timeout_s <= 60.0:
            raise ConfigError(f"open_timeout_s must be 0 to 60; found {self.open_timeout_s}")
        self._check_security()

    def _check_security(self) -> None:
        for endpoint in (*self.connect, *self.listen):
            if self.tls is not None and not _TLS_ENDPOINT.fullmatch(endpoint):
                raise ConfigError(
                    f"with certificates an endpoint looks like {LOOPBACK_TLS!r}, at most with "
                    f"#iface=eth0 behind it; found {endpoint!r}"
                )
            if self.tls is None and endpoint.startswith(("tls/", "quic/")):
                raise ConfigError(f"{endpoint!r} needs certificates; name their folder (--keys)")
        if self.access is not None and not (self.listen and self.tls and self.tls.mutual):
            raise ConfigError(
                "access rules go by the names in certificates: they need mutual TLS, on the "
                "process that listens"
            )

    @classmethod
    def hub(cls, *listen: str, robot: str = "robot", **others: Any) -> "LinkConfig":
        """What the process that others connect to opens; on loopback unless told otherwise."""
        endpoints = listen or (loopback(others.get("tls")),)
        return cls(mode="router", connect=(), listen=endpoints, robot=robot, **others)

    @property
    def exposed(self) -> tuple[str, ...]:
        """Endpoints that other machines can reach."""
        return tuple(endpoint for endpoint in self.listen if not _on_loopback(endpoint))

    def check(self) -> None:
        """Read and check what opening the link relies on; warn where it lets strangers in.

        Raises:
            ConfigError: see `TlsConfig.check`.
        """
        if self.tls is not None:
            self.tls.check(listens=bool(self.listen), connects=bool(self.connect))
        if self.exposed and not (self.tls and self.tls.mutual):
            logger.warning(
                "ANYONE who reaches %s can drive this robot: it listens beyond this machine and "
                "asks nobody for a certificate. Listen on %s, or see docs/security.md",
                ", ".join(self.exposed),
                LOOPBACK,
            )

    def own_key(self, name: str) -> str:
        """Key of this project's own data and calls, such as "status" or "rpc/reset"."""
        return f"cbe/v1/{self.robot}/{name}"

    def zenoh_json5(self) -> dict[str, str]:
        """Zenoh's configuration keys and their JSON values."""
        values: dict[str, Any] = {
            "mode": self.mode,
            "connect/endpoints": self.connect,
            "connect/timeout_ms": round(1000 * self.open_timeout_s),
            "connect/exit_on_failure": True,
            # The default waits up to 4 s between attempts after an outage.
            "connect/retry": {
                "period_init_ms": 100,
                "period_max_ms": 500,
                "period_increase_factor": 2,
            },
            "listen/endpoints": self.listen,
            "listen/exit_on_failure": True,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            # A hung neighbour is noticed after 2 s instead of 10 s.
            "transport/link/tx/lease": 2000,
            # Two, the default, let a starved processor drop what one burst holds.
            "transport/link/tx/queue/size/data": 8,
            "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
            # It gains nothing at these sizes and costs a pool of 16 MiB.
            "transport/shared_memory/enabled": False,
        }
        if self.tls is not None:
            values["transport/link/tls"] = self.tls.zenoh()
        if self.access is not None:
            values["access_control"] = self.access.zenoh(self.robot, self.style, self.domain)
        return {key: json.dumps(value) for key, value in values.items()}


def loopback(tls: TlsConfig | None) -> str:
    """The endpoint of a hub on this machine."""
    return LOOPBACK if tls is None else LOOPBACK_TLS


def _on_loopback(endpoint: str) -> bool:
    match = _ENDPOINT.fullmatch(endpoint)
    host = match["host"].strip("[]") if match else "localhost"  # a socket file is local
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
