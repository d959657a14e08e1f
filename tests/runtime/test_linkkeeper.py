import socket
import time

import pytest
import zenoh

from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.messages import Twist, TwistStamped
from cbe.topics import CMD_VEL
from cbe_runtime.linkkeeper import MAX_PAUSE_S, SILENT_S, LinkKeeper

DEADLINE_S = 60.0  # for what takes a moment on an idle machine


class FakeLink:
    def __init__(self):
        self.heard_s = -float("inf")
        self.opens = True
        self.tries = 0

    def renew(self, timeout_s):
        self.tries += 1
        return self.opens


class Watched:
    def __init__(self):
        self.now_s = 100.0
        self.link = FakeLink()
        self.keeper = LinkKeeper(self.link, lambda: self.now_s)

    def pass_s(self, seconds):
        before = self.link.tries
        for _ in range(round(seconds / 0.1)):
            self.now_s += 0.1
            self.keeper.poll()
        return self.link.tries - before


@pytest.fixture
def watched():
    return Watched()


def test_link_that_was_never_heard_is_left_alone(watched):
    assert watched.pass_s(60.0) == 0


def test_silent_network_is_tried_again_and_again(watched):
    watched.link.heard_s, watched.link.opens = watched.now_s, False
    assert watched.pass_s(SILENT_S - 0.1) == 0
    assert watched.pass_s(5.0) >= 45
    assert watched.keeper.renewals == 0


def test_renewals_that_bring_nothing_become_rare(watched):
    watched.link.heard_s = watched.now_s
    watched.pass_s(60.0)
    assert watched.pass_s(10 * MAX_PAUSE_S) == pytest.approx(10, abs=1)
    watched.link.heard_s = watched.now_s
    assert watched.pass_s(SILENT_S + 0.2) == 1


@pytest.fixture
def hub():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with Link.open(LinkConfig.hub(endpoint)) as link:
        yield link


def until(condition, meanwhile=lambda: None):
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        meanwhile()
        if value := condition():
            return value
        time.sleep(0.01)
    return pytest.fail("not within the deadline")


@pytest.mark.loopback
def test_session_that_went_deaf_is_replaced(hub):
    command = TwistStamped(1, "base_link", Twist.planar(0.1, 0.0))
    said, heard = hub.publisher(CMD_VEL), hub.latest_json("status")
    with Link.open(LinkConfig(connect=hub.config.listen)) as link, LinkKeeper(link) as keeper:
        latest, statuses = link.latest(CMD_VEL), link.json_publisher("status")
        link.serve("ping", lambda _: {"pong": True})
        link.declare_alive("pinger")
        until(latest.get, lambda: said.put(command))
        deaf, before = link._session, latest.stats.received
        for declared in link._declared:
            if not isinstance(declared, zenoh.Publisher):
                declared.undeclare()  # nothing is heard, served or alive any more
        until(lambda: latest.stats.received > before + 3, lambda: said.put(command))
        assert keeper.renewals >= 1
        until(heard.get, lambda: statuses.put({"state": "IDLE"}))
        assert hub.call("ping", timeout_s=DEADLINE_S) == {"pong": True}
        until(lambda: hub.alive("pinger"))
        until(deaf.is_closed)


@pytest.mark.loopback
def test_link_that_listens_is_not_renewed_nor_one_that_is_closed(hub):
    assert not hub.renew(1.0)
    link = Link.open(LinkConfig(connect=hub.config.listen))
    link.close()
    assert not link.renew(10.0)
    assert link._session.is_closed()
