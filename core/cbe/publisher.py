"""Publishing under one key of a link, without ever waiting for a receiver."""

from __future__ import annotations

import struct
import time
import uuid
from typing import TYPE_CHECKING, Generic, TypeVar

import zenoh

from cbe.errors import LinkError

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

_ATTACHMENT = struct.Struct("<qqB16s")
"""rmw_zenoh's: sequence number, time sent in ns, length of the writer's id, that id."""
_ID_SIZE = 16


class Publisher(Generic[T]):
    """Publishes under one key; drops a message rather than wait for a slow receiver."""

    def __init__(self, key: str, encode: Callable[[T], bytes], attach: bool = False) -> None:
        self._key = key
        self._encode = encode
        self._id = uuid.uuid4().bytes if attach else None
        self._sequence = 0
        self._publisher: zenoh.Publisher | None = None

    def declare(self, session: zenoh.Session) -> zenoh.Publisher:
        """Publish by this session from now on; raises zenoh.ZError where it is closed."""
        # BLOCK would stall a put for 5 s on a subscriber that has stopped.
        drop = zenoh.CongestionControl.DROP
        self._publisher = session.declare_publisher(self._key, congestion_control=drop)
        return self._publisher

    def put(self, message: T) -> None:
        """Send; raises MessageError for a value that does not fit, LinkError on a closed link."""
        attachment = None
        if self._id is not None:
            self._sequence += 1
            attachment = _ATTACHMENT.pack(self._sequence, time.time_ns(), _ID_SIZE, self._id)
        payload = self._encode(message)
        while True:
            publisher = self._publisher
            assert publisher is not None
            try:
                publisher.put(payload, attachment=attachment)
                return
            except zenoh.ZError as error:
                if publisher is self._publisher:  # else the link was renewed meanwhile
                    raise LinkError(f"cannot publish {self._key}: {error}") from error


def sequence(attachment: zenoh.ZBytes | None) -> int | None:
    """The sender's sequence number; bare topics carry none."""
    if attachment is None or len(attachment) != _ATTACHMENT.size:
        return None
    number: int = _ATTACHMENT.unpack(attachment.to_bytes())[0]
    return number
