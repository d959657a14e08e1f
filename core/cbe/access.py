"""Who may do what on a link: names of certificates, and Zenoh's rules for them."""

from __future__ import annotations

import re
from dataclasses import astuple, dataclass
from typing import Any

from cbe.errors import ConfigError
from cbe.topics import (
    CAMERA,
    CAMERA_INFO,
    CAMERA_RAW,
    CMD_VEL,
    CMD_VEL_UNSTAMPED,
    ODOM,
    SCAN,
    KeyStyle,
    subscription,
)

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
"""A certificate's common name, also a folder's."""

_READS = ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_SERVES = ["declare_queryable", "reply"]
_MESSAGES = ["put", "delete", "query", "liveliness_token", *_SERVES, *_READS]


@dataclass(frozen=True, slots=True)
class AccessConfig:
    """Common names of certificates by what their bearers may do; every listed one may listen.

    drive: publish cmd_vel and the runtime's state, serve calls. sense: publish sensors, serve
    calls. call: call what others serve. read: nothing more, but a recorder or teacher can be
    ended by a call. Who is on no list may do nothing at all.
    """

    drive: tuple[str, ...] = ()
    sense: tuple[str, ...] = ()
    call: tuple[str, ...] = ()
    read: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse an empty list of names, and names no certificate of ours can bear."""
        if not self.names:
            raise ConfigError("access rules name nobody, so nobody could do anything")
        for name in self.names:
            if not NAME.fullmatch(name):
                raise ConfigError(f"{name!r} is no name of a certificate; letters, digits, _.-")

    @property
    def names(self) -> tuple[str, ...]:
        """Everyone on a list, once."""
        return tuple(dict.fromkeys(name for names in astuple(self) for name in names))

    def zenoh(self, robot: str, style: KeyStyle, domain: int) -> dict[str, Any]:
        """Zenoh's `access_control` for the process that others connect to.

        What is not allowed here is denied. A wildcard key is allowed only where a rule holds
        all that it could mean.
        """
        own = f"cbe/v1/{robot}/"
        commands = [subscription(topic, style, domain) for topic in (CMD_VEL, CMD_VEL_UNSTAMPED)]
        sensors = [
            subscription(topic, style, domain)
            for topic in (CAMERA, CAMERA_RAW, CAMERA_INFO, SCAN, ODOM)
        ]
        rules = [
            _rule("listen", _READS, ["**"]),
            _rule("hear", _MESSAGES, ["**"], flow="egress"),
            _rule("command", ["put"], [*dict.fromkeys(commands), f"{own}*"]),
            _rule("sensors", ["put"], [*sensors, f"{own}truth"]),
            _rule("serve", _SERVES, [f"{own}rpc/*"]),
            _rule("live", ["liveliness_token"], [f"{own}alive/*"]),
            _rule("call", ["query"], [f"{own}rpc/*"]),
            # A reader who could serve "stop" would swallow it.
            _rule("end", _SERVES, [f"{own}rpc/record_stop", f"{own}rpc/teach_stop"]),
            _rule(
                "live as reader",
                ["liveliness_token"],
                [f"{own}alive/{name}" for name in ("record", "black_box", "teach", "view")],
            ),
        ]
        granted = (
            (self.drive, ("command", "serve", "live")),
            (self.sense, ("sensors", "serve", "live")),
            (self.call, ("call",)),
            (self.read, ("end", "live as reader")),
        )
        may = {
            name: dict.fromkeys(rule for names, each in granted if name in names for rule in each)
            for name in self.names
        }
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": name, "cert_common_names": [name]} for name in self.names],
            "policies": [
                {"rules": ["listen", "hear", *may[name]], "subjects": [name]} for name in self.names
            ],
        }


def _rule(name: str, messages: list[str], keys: list[str], flow: str = "ingress") -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": messages,
        "key_exprs": keys,
    }
