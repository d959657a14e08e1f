"""The link on loopback: delivery, loss, calls, liveliness, failure and recovery."""

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import zenoh

import cbe.link
from cbe.errors import ConfigError, LinkError, MessageError
from cbe.inbox import Latest, Stream
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe.messages import Twist, TwistStamped
from cbe.rays import scan_message
from cbe.topics import CMD_VEL, CMD_VEL_UNSTAMPED, SCAN, KeyStyle, key_expression

DEADLINE_S = 60.0  # for what takes a moment on an idle machine

pytestmark = pytest.mark.loopback


def command(speed_mps: float, stamp_ns: int = 0) -> TwistStamped:
    return TwistStamped(stamp_ns, "base_link", Twist.planar(speed_mps, 0.0))


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def until(condition: Callable[[], Any], meanwhile: Callable[[], Any] = lambda: None) -> Any:
    """What `condition` gives once it is true; repeats `meanwhile` until then."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        meanwhile()
        if value := condition():
            return value
        time.sleep(0.005)
    pytest.fail("not within the deadline")


@pytest.fixture(scope="module")
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture(scope="module")
def hub(endpoint: str) -> Iterator[Link]:
    with Link.open(LinkConfig.hub(endpoint)) as link:
        yield link


@pytest.fixture(scope="module")
def client(hub: Link, endpoint: str) -> Iterator[Link]:
    with Link.open(LinkConfig(connect=(endpoint,))) as link:
        yield link


def test_newest_message_is_what_is_read(hub: Link, client: Link) -> None:
    latest, publisher = client.latest(CMD_VEL), hub.publisher(CMD_VEL)
    until(latest.get, lambda: publisher.put(command(0.1)))
    publisher.put(command(0.2))
    received = until(lambda: (now := latest.get()).message == command(0.2) and now)
    assert received.error is None
    assert received.received_s <= time.monotonic()
    assert latest.get() is received


def test_siblings_at_one_hub_hear_each_other(hub: Link, client: Link, endpoint: str) -> None:
    topic = replace(SCAN, name="siblings/scan")
    with Link.open(LinkConfig(connect=(endpoint,))) as sibling:
        latest, publisher = client.latest(topic), sibling.publisher(topic)
        scan = scan_message(np.full(240, 2.0), stamp_ns=5)
        received = until(latest.get, lambda: publisher.put(scan))
    assert received.message.stamp_ns == 5


@pytest.mark.parametrize("topic", [CMD_VEL, CMD_VEL_UNSTAMPED])
def test_bare_names_are_published_without_attachment(topic: Any, endpoint: str, hub: Link) -> None:
    samples: list[zenoh.Sample] = []
    message = command(0.5) if topic is CMD_VEL else Twist.planar(0.5, 0.0)
    topic = replace(topic, name=f"bare/{topic.message.__name__}")
    hub._session.declare_subscriber(topic.name, samples.append)
    with Link.open(LinkConfig(connect=(endpoint,), style=KeyStyle.BARE)) as bare:
        publisher = bare.publisher(topic)
        until(lambda: samples, lambda: publisher.put(message))
    assert samples[0].attachment is None
    assert topic.message.from_cdr(samples[0].payload.to_bytes()) == message


def test_attachment_is_what_rmw_zenoh_expects(hub: Link, client: Link) -> None:
    samples: list[zenoh.Sample] = []
    topic = replace(CMD_VEL, name="attached")
    key = key_expression(topic, KeyStyle.RMW_ZENOH)
    subscriber = hub._session.declare_subscriber(key, samples.append)
    publisher = client.publisher(topic)
    until(lambda: len(samples) > 1, lambda: publisher.put(command(0.0)))
    subscriber.undeclare()
    first, second = (
        struct.unpack("<qqB16s", sample.attachment.to_bytes()) for sample in samples[:2]
    )
    assert second[0] == first[0] + 1
    assert abs(first[1] - time.time_ns()) < 60e9
    assert first[2] == 16
    assert first[3] == second[3] != bytes(16)


def test_link_does_not_hear_itself(hub: Link, client: Link) -> None:
    topic = replace(CMD_VEL, name="itself")
    own, other = hub.latest(topic), client.latest(topic)
    publisher = hub.publisher(topic)
    until(other.get, lambda: publisher.put(command(0.0)))
    assert own.get() is None


def test_malformed_message_shows_as_error_and_the_next_is_read(hub: Link, client: Link) -> None:
    topic = replace(CMD_VEL, name="malformed")
    latest, key = client.latest(topic), key_expression(topic, KeyStyle.RMW_ZENOH)
    received = until(latest.get, lambda: hub._session.put(key, b"\0\1\0\0junk"))
    assert received.message is None
    assert isinstance(received.error, MessageError)
    assert latest.stats.malformed == 1
    publisher = hub.publisher(topic)
    publisher.put(command(0.4))
    assert until(lambda: (latest.get() or received).message) == command(0.4)


def test_stream_keeps_every_message_in_order(hub: Link, client: Link) -> None:
    topic = replace(CMD_VEL, name="recorded")
    stream, publisher = client.stream(topic), hub.publisher(topic)
    until(lambda: stream.drain(0.01), lambda: publisher.put(command(0.0)))
    samples: list[Any] = []
    for stamp_ns in range(1, 11):
        publisher.put(command(0.0, stamp_ns))
        # One at a time: a burst may be dropped in part.
        until(
            lambda: samples and TwistStamped.from_cdr(samples[-1].payload).stamp_ns == stamp_ns,  # noqa: B023
            lambda: samples.extend(stream.drain(0.1)),
        )
    stamps = [TwistStamped.from_cdr(sample.payload).stamp_ns for sample in samples]
    assert [stamp for stamp in stamps if stamp] == list(range(1, 11))
    assert stream.dropped == 0


def test_json_status_arrives(hub: Link, client: Link) -> None:
    latest, publisher = client.latest_json("status"), hub.json_publisher("status")
    status = {"state": "FOLLOWING", "progress": 0.5, "ages": [0.1, None]}
    assert until(latest.get, lambda: publisher.put(status)).message == status


def ready(link: Link, name: str) -> None:
    """Wait until a call is served."""

    def served() -> bool:
        with contextlib.suppress(LinkError):
            link.call(name, {"probe": True}, timeout_s=1.0)
            return True
        return False

    until(served)


def test_call_returns_what_the_handler_answers(hub: Link, client: Link) -> None:
    hub.serve("double", lambda request: {"value": 2 * request.get("value", 0)})
    ready(client, "double")
    assert client.call("double", {"value": 21}, DEADLINE_S) == {"value": 42}


@pytest.mark.parametrize("error", [ConfigError("no such pose"), ZeroDivisionError("oh")])
def test_exception_of_a_handler_reaches_the_caller(
    error: Exception, hub: Link, client: Link
) -> None:
    def fail(request: dict[str, Any]) -> dict[str, Any]:
        if "probe" in request:
            return {}
        raise error

    name = f"fail_{type(error).__name__}"
    hub.serve(name, fail)
    ready(client, name)
    with pytest.raises(LinkError, match=str(error)):
        client.call(name, timeout_s=DEADLINE_S)


def test_request_that_is_no_json_object_gets_an_error_reply(hub: Link, client: Link) -> None:
    hub.serve("echo", lambda request: request)
    ready(client, "echo")
    for payload in (b"[1]", b"{", b"\xff\xfe", b"[" * 100_000):
        replies = list(client._session.get("cbe/v1/robot/rpc/echo", payload=payload))
        assert b"JSON" in replies[0].err.payload.to_bytes()


def test_call_that_nobody_serves_fails(client: Link) -> None:
    with pytest.raises(LinkError, match="nobody answers"):
        client.call("nothing", timeout_s=0.3)


def test_call_that_takes_too_long_fails(hub: Link, client: Link) -> None:
    release = threading.Event()

    def hang(request: dict[str, Any]) -> dict[str, Any]:
        if "probe" not in request:
            release.wait(DEADLINE_S)
        return {}

    hub.serve("hang", hang)
    ready(client, "hang")
    with pytest.raises(LinkError, match=r"within 0\.2 s"):
        client.call("hang", timeout_s=0.2)
    release.set()


def test_call_that_ends_its_server_is_answered(hub: Link, endpoint: str) -> None:
    ending = threading.Event()
    link = Link.open(LinkConfig(connect=(endpoint,)))

    def end(request: dict[str, Any]) -> dict[str, Any]:
        if "probe" not in request:
            ending.set()
            time.sleep(0.1)  # the other thread is well ahead
        return {"ended": True}

    def close() -> None:
        ending.wait(DEADLINE_S)
        link.close()

    link.serve("end", end)
    ready(hub, "end")
    closing = threading.Thread(target=close)
    closing.start()
    assert hub.call("end") == {"ended": True}
    closing.join(DEADLINE_S)
    assert link._session.is_closed()


def test_handler_that_hangs_holds_up_closing_for_a_moment_only(
    hub: Link, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cbe.link, "ANSWER_PATIENCE_S", 0.05)
    called, release = threading.Event(), threading.Event()

    def hang(_request: dict[str, Any]) -> dict[str, Any]:
        called.set()
        release.wait(DEADLINE_S)
        return {}

    link = Link.open(LinkConfig(connect=(endpoint,)))
    link.serve("hang_on", hang)
    with contextlib.suppress(LinkError):
        until(called.is_set, lambda: hub.call("hang_on", timeout_s=0.1))
    link.close()
    assert link._session.is_closed()
    release.set()


def test_liveliness_follows_a_process(hub: Link, client: Link, endpoint: str) -> None:
    seen: list[bool] = []
    client.watch_alive("sibling", seen.append)
    assert not client.alive("sibling")
    with Link.open(LinkConfig(connect=(endpoint,))) as sibling:
        sibling.declare_alive("sibling")
        until(lambda: client.alive("sibling"))
        until(lambda: seen == [True])
    until(lambda: not client.alive("sibling"))
    until(lambda: seen == [True, False])


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_absent_endpoint_fails_naming_it(mode: Any) -> None:
    absent = free_endpoint()
    with pytest.raises(LinkError, match=f"no answer from {absent} within 0.3 s"):
        Link.open(LinkConfig(mode=mode, connect=(absent,), open_timeout_s=0.3))


def test_endpoint_in_use_fails_naming_it(hub: Link, endpoint: str) -> None:
    with pytest.raises(LinkError, match=endpoint):
        Link.open(LinkConfig.hub(endpoint))


def test_two_peers_need_no_hub() -> None:
    endpoint = free_endpoint()
    with (
        Link.open(LinkConfig(mode="peer", connect=(), listen=(endpoint,))) as one,
        Link.open(LinkConfig(mode="peer", connect=(endpoint,))) as two,
    ):
        latest, publisher = one.latest(CMD_VEL), two.publisher(CMD_VEL)
        until(latest.get, lambda: publisher.put(command(0.0)))


def test_client_hears_again_after_the_hub_restarts() -> None:
    endpoint = free_endpoint()
    hub = Link.open(LinkConfig.hub(endpoint))
    with Link.open(LinkConfig(connect=(endpoint,))) as client:
        latest, publisher = client.latest(CMD_VEL), hub.publisher(CMD_VEL)
        until(latest.get, lambda: publisher.put(command(0.1)))
        hub.close()
        with Link.open(LinkConfig.hub(endpoint)) as restarted:
            # The client's publishers work again too, not its subscribers alone.
            back, again = restarted.latest(SCAN), restarted.publisher(CMD_VEL)
            until(lambda: latest.get().message == command(0.2), lambda: again.put(command(0.2)))
            scans = client.publisher(SCAN)
            until(back.get, lambda: scans.put(scan_message(np.ones(240), 1)))


def test_closed_link_refuses_use_and_closes_again(endpoint: str, hub: Link) -> None:
    link = Link.open(LinkConfig(connect=(endpoint,)))
    publisher = link.publisher(CMD_VEL)
    link.close()
    link.close()
    for use in (
        lambda: publisher.put(command(0.0)),
        lambda: link.latest(CMD_VEL),
        lambda: link.call("double"),
        lambda: link.alive("hub"),
        lambda: link.declare_alive("late"),
    ):
        with pytest.raises(LinkError):
            use()


@pytest.mark.parametrize(
    "bad",
    [
        {"mode": "broker"},
        {"connect": ()},
        {"connect": ("127.0.0.1:7447",)},
        {"connect": ("tcp/127.0.0.1",)},
        {"listen": ("tcp/127.0.0.1:7447",)},
        {"domain": 500},
        {"robot": "a/b"},
        {"robot": "*"},
        {"open_timeout_s": 0.0},
    ],
    ids=repr,
)
def test_configuration_that_cannot_work_is_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        LinkConfig(**bad)


def test_only_endpoints_beyond_loopback_count_as_exposed() -> None:
    inside = ("tcp/127.0.0.1:1", "tcp/[::1]:1", "tcp/localhost:1", "unixsock-stream//tmp/x")
    outside = ("tcp/0.0.0.0:1", "tcp/[::]:1", "udp/robot.local:1")
    assert LinkConfig.hub(*inside, *outside).exposed == outside
    assert LinkConfig.hub().exposed == ()


def test_messages_replaced_before_they_were_read_are_counted() -> None:
    latest = Latest(bytes.decode)
    for payload in (b"a", b"b", b"c"):
        latest.store(payload)
    latest.get()
    latest.store(b"d")
    assert (latest.stats.received, latest.stats.overwritten) == (4, 2)


def test_gaps_in_the_senders_sequence_are_counted_but_not_its_restart() -> None:
    latest = Latest(bytes.decode)
    for sequence in (1, 2, 5, 6, 1, 2):
        latest.store(b"x", sequence)
    assert latest.stats.lost == 2


def test_wait_returns_the_next_message_or_gives_up() -> None:
    now = iter([10.0, 20.0])
    latest = Latest(bytes.decode, clock=lambda: next(now))
    assert latest.wait(timeout_s=0.0) is None
    latest.store(b"a")
    first = latest.wait()
    assert first is not None
    assert (first.message, first.received_s, first.count) == ("a", 10.0, 1)
    assert latest.wait(after=1, timeout_s=0.0) is None
    threading.Timer(0.05, latest.store, [b"b"]).start()
    second = latest.wait(after=1, timeout_s=DEADLINE_S)
    assert second is not None
    assert (second.message, second.received_s, second.count) == ("b", 20.0, 2)


def test_full_stream_drops_the_oldest_and_says_so() -> None:
    stream = Stream(capacity=2)
    for payload in (b"a", b"b", b"c"):
        stream.store(payload)
    assert [sample.payload for sample in stream.drain()] == [b"b", b"c"]
    assert stream.dropped == 1
    assert stream.drain() == []
