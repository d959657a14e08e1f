"""Tells systemd, where it is the parent, how this process is doing (sd_notify's protocol)."""

import os
import socket


def notify(state: str) -> None:
    """Send a state such as `READY=1`; does nothing when not started by systemd."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]  # an abstract socket
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
        channel.connect(address)
        channel.sendall(state.encode())
