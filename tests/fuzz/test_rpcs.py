"""Calls, status objects and attachments, through a link whose session is a stand-in for Zenoh's."""

import threading

import msgspec
import zenoh

from cbe import topics
from cbe.errors import CbeError
from cbe.link import Link
from cbe.linkconfig import LinkConfig
from cbe_runtime.loop import Loop, LoopConfig

from .harness import SEED
from .mutate import mutants

EXAMPLES = [
    b"{}",
    b'{"name": "x", "n": [1, 2.5, null, true], "of": {"a": "b"}}',
    b'{"state":"IDLE"}',
]
TOKENS = [b"{", b"}", b"[", b"]", b":", b",", b'"', b"\\ud800", b"\\u0000", b"1e400", b"-0", b"NaN"]
TOKENS += [b"9" * 400, b"Infinity", b"null", b"true", b"\xff", b"\xef\xbb\xbf", b'"a":1,' * 50]


class Query:
    """A call as Zenoh hands it over; remembers what was answered."""

    def __init__(self, payload):
        self.payload = zenoh.ZBytes(payload) if payload is not None else None
        self.replies, self.errors = [], []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def reply(self, _key, payload):
        self.replies.append(payload)

    def reply_err(self, payload):
        self.errors.append(payload)


class Sample:
    """A publication as Zenoh hands it over."""

    kind = zenoh.SampleKind.PUT

    def __init__(self, payload, attachment):
        self.payload = zenoh.ZBytes(payload)
        self.attachment = zenoh.ZBytes(attachment)


class Session:
    """Keeps what the link declares, so that a test can call it."""

    def __init__(self):
        self.queryables, self.subscribers = {}, {}

    def declare_queryable(self, key, answer):
        self.queryables[key] = answer

    def declare_subscriber(self, key, on_sample, **_):
        self.subscribers[key] = on_sample

    def declare_publisher(self, key, **_):
        return key

    def liveliness(self):
        return self

    def declare_token(self, key):
        return key


class Follower:
    """Counts what it is told."""

    segments = 3

    def __init__(self):
        self.told = []

    def start(self):
        self.told.append("start")

    def stop(self):
        self.told.append("stop")

    def relocalise(self, near=None):
        self.told.append("relocalise")


def attacks():
    yield b"[" * 200_000
    yield b'{"a":' * 200_000
    yield b'{"a":' + b"[" * 900 + b"]" * 900 + b"}"
    yield b'{"a": [' + b"[]," * 1_000_000 + b"[]]}"
    yield b'{"a": ' + b"9" * 1_000_000 + b"}"
    yield b'{"a": "' + b"x" * 1_000_000 + b'"}'
    yield b"{" + b",".join(b'"%d":0' % n for n in range(300_000)) + b"}"
    yield b""
    yield bytes(2**23)


def test_hostile_call_is_answered_soon_and_small(fuzzed):
    session, follower = Session(), Follower()
    link = Link(session, LinkConfig())
    Loop(link, follower, None, LoopConfig(), threading.Event())
    assert len(session.queryables) == 4

    def read(data):
        refusals = set()
        for answer in session.queryables.values():
            query = Query(data)
            answer(query)
            assert len(query.replies) + len(query.errors) == 1
            refusals.update(query.errors)
        if refusals:
            (reason,) = refusals
            raise CbeError(reason.decode())

    report = fuzzed("rpcs", read, EXAMPLES, mutants(EXAMPLES, SEED, TOKENS), attacks=attacks())
    assert 0 < report.accepted < report.inputs
    assert follower.told.count("start") == follower.told.count("stop") > 0


def test_hostile_status_is_refused_soon_and_small(fuzzed):
    """What a viewer or a test reads of a robot's status, and a topic's sequence numbers."""
    session = Session()
    link = Link(session, LinkConfig())
    statuses, commands = link.latest_json("status"), link.latest(topics.CMD_VEL)
    status_key, command_key = session.subscribers

    def read(data):
        session.subscribers[command_key](Sample(data, data[:33]))
        received = commands.get()
        assert (received.message is None) == (received.error is not None)
        session.subscribers[status_key](Sample(data, data))
        received = statuses.get()
        if received.error is not None:
            raise CbeError(str(received.error))
        assert isinstance(received.message, dict)
        msgspec.json.encode(received.message)

    report = fuzzed("statuses", read, EXAMPLES, mutants(EXAMPLES, SEED, TOKENS), attacks=attacks())
    assert 0 < report.accepted < report.inputs
    assert statuses.stats.received == report.inputs + len(EXAMPLES)
