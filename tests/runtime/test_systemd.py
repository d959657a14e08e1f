import os
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


@pytest.fixture
def manager(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"{tmp_path}/n")
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", f"{tmp_path}/n")
        yield manager


def messages(manager):
    heard = []
    while True:
        try:
            heard.append(manager.recv(64))
        except BlockingIOError:
            return heard


@pytest.mark.parametrize("process", [None, str(os.getpid())], ids=["any", "this"])
def test_heart_beats_four_times_in_the_watchdogs_time(manager, monkeypatch, process):
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    if process:
        monkeypatch.setenv("WATCHDOG_PID", process)
    now_s = 0.0
    heart = systemd.Heartbeat(lambda: now_s)
    assert messages(manager) == []
    for step in range(31):
        now_s = 0.1 * step
        heart.beat()
    assert messages(manager) == [b"READY=1", *[b"WATCHDOG=1"] * 7]


@pytest.mark.parametrize(
    "environment",
    [{}, {"WATCHDOG_USEC": "no number"}, {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}],
    ids=repr,
)
def test_who_is_not_watched_only_says_that_it_is_ready(manager, monkeypatch, environment):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    heart = systemd.Heartbeat(lambda: 0.0)
    heart.beat()
    heart.beat()
    assert messages(manager) == [b"READY=1"]


def test_manager_that_does_not_listen_holds_nothing_up(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", f"{tmp_path}/absent")
    systemd.notify("WATCHDOG=1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(f"{tmp_path}/absent")
        for _ in range(2_000):  # far more than its queue holds
            systemd.notify("WATCHDOG=1")
