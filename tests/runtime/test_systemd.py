import socket

import pytest

from cbe_runtime import systemd


@pytest.mark.parametrize("abstract", [False, True])
def test_state_reaches_the_notify_socket(tmp_path, monkeypatch, abstract):
    name = f"{tmp_path}/n"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name if abstract else name)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name if abstract else name)
        systemd.notify("READY=1")
        manager.settimeout(5)
        assert manager.recv(64) == b"READY=1"


def test_without_systemd_nothing_happens(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    systemd.notify("READY=1")
