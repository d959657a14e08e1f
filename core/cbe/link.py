"""The Zenoh link: latest-value subscribers, publishers that never block, calls and liveliness."""

from __future__ import annotations

import logging
import math
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import msgspec
import zenoh

from cbe.errors import CbeError, LinkError, MessageError
from cbe.inbox import Latest, Stream
from cbe.publisher import Publisher, sequence
from cbe.topics import KeyStyle, key_expression, subscription

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from cbe.codec import Message
    from cbe.linkconfig import LinkConfig
    from cbe.topics import M, Topic

logger = logging.getLogger(__name__)

JsonObject = dict[str, Any]

MAX_JSON_BYTES = 2**16
"""Of a call or a status: ours have about a thousand; objects take many times that to unpack."""
RETRY_S = 0.05  # between two tries to reach a process that may be starting
ANSWER_PATIENCE_S = 1.0
"""Closing waits this long for calls that are being answered."""


class Link:
    """A session on Zenoh, closed by `close` or at the end of `with`.

    It never hears its own messages. Methods raise LinkError once it is closed.
    """

    def __init__(self, session: zenoh.Session, config: LinkConfig) -> None:
        self._session = session
        self._declarations: list[Callable[[zenoh.Session], object]] = []
        self._declared: list[object] = []  # what Python drops, Zenoh undeclares
        self._renewing = threading.Lock()
        self._answering = 0  # calls
        self._answered = threading.Condition()
        self.config = config
        self.heard_s = -math.inf
        """When a subscribed topic was last heard, by the monotonic clock."""

    @classmethod
    def open(cls, config: LinkConfig) -> Link:
        """Connect and listen; raises LinkError within `open_timeout_s` where that fails.

        Raises ConfigError, before anything is opened, for certificates that cannot work.
        """
        config.check()
        return cls(_session(config), config)

    def renew(self, timeout_s: float) -> bool:
        """Change to a new session if one opens within the time; tells whether it did.

        A session is slow to notice that a silent network is back (TCP and Zenoh both wait longer
        with each failure), and may go deaf for good. Publishers, inboxes and calls served stay
        the same. Only a link in client mode can be renewed: one that listens holds its port.
        """
        if self.config.mode != "client":
            return False
        try:
            session = _session(replace(self.config, open_timeout_s=timeout_s))
        except LinkError:
            return False
        with self._renewing:
            try:
                if self._session.is_closed():
                    raise zenoh.ZError("the link is closed")
                declared = [declare(session) for declare in self._declarations]
            except zenoh.ZError:
                _close(session)
                return False
            old, self._session, self._declared = self._session, session, declared
        # Closing waits up to 10 s for a network that does not answer.
        threading.Thread(target=_close, args=(old,), name="link closer").start()
        return True

    def close(self) -> None:
        """Undeclare everything and disconnect; again does nothing.

        Calls that are being answered come first: one that ends the process, such as a recorder's
        `record_stop`, would else be overtaken by the end and its caller told that nobody answers.
        """
        with self._answered:
            self._answered.wait_for(lambda: not self._answering, ANSWER_PATIENCE_S)
        with self._renewing:
            if not self._session.is_closed():
                self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self, topic: Topic[M]) -> Latest[M]:
        """A slot with the newest message of a topic."""
        inbox = Latest(topic.message.from_cdr)
        self._subscribe(self._subscription(topic), inbox)
        return inbox

    def stream(self, topic: Topic[Any], capacity: int = 256) -> Stream:
        """Every message of a topic as CDR bytes, for a recorder."""
        inbox = Stream(capacity)
        self._subscribe(self._subscription(topic), inbox)
        return inbox

    def publisher(self, topic: Topic[M]) -> Publisher[M]:
        """A publisher of a topic's messages."""
        style = self.config.style
        key = key_expression(topic, style, self.config.domain)
        publisher: Publisher[M] = Publisher(key, _cdr, attach=style is KeyStyle.RMW_ZENOH)
        self._declare(key, publisher.declare)
        return publisher

    def latest_json(self, name: str) -> Latest[JsonObject]:
        """A slot with the newest JSON object under this robot's own key, such as "status"."""
        inbox = Latest(_from_json)
        self._subscribe(self.config.own_key(name), inbox)
        return inbox

    def stream_json(self, name: str, capacity: int = 256) -> Stream:
        """Every JSON object under this robot's own key as bytes, for a recorder."""
        inbox = Stream(capacity)
        self._subscribe(self.config.own_key(name), inbox)
        return inbox

    def json_publisher(self, name: str) -> Publisher[JsonObject]:
        """A publisher of JSON objects under this robot's own key."""
        key = self.config.own_key(name)
        publisher: Publisher[JsonObject] = Publisher(key, msgspec.json.encode)
        self._declare(key, publisher.declare)
        return publisher

    def serve(self, name: str, handler: Callable[[JsonObject], JsonObject]) -> None:
        """Answer calls to `rpc/<name>`; an exception of the handler is sent as an error reply.

        The handler runs in a thread of its own, one call at a time.
        """
        key = self.config.own_key(f"rpc/{name}")

        def answer(query: zenoh.Query) -> None:
            with self._busy_answering(), query:
                payload = query.payload
                try:
                    request = _from_json(payload.to_bytes()) if payload else {}
                    query.reply(key, msgspec.json.encode(handler(request)))
                except CbeError as error:
                    query.reply_err(str(error).encode())
                except Exception as error:  # unanswered, the caller would wait in vain
                    logger.exception("rpc %s failed", name)
                    query.reply_err(f"{type(error).__name__}: {error}".encode())

        self._declare(key, lambda session: session.declare_queryable(key, answer))

    def call(
        self, name: str, request: JsonObject | None = None, timeout_s: float = 5.0
    ) -> JsonObject:
        """The reply to `rpc/<name>`; raises LinkError for an error reply, or for none in time.

        A process that has just started is waited for: it takes a moment to be heard of.
        """
        key = self.config.own_key(f"rpc/{name}")
        payload = msgspec.json.encode(request or {})
        deadline = time.monotonic() + timeout_s
        while True:
            # Never so short that a busy link could not even say that nobody is there.
            left_s = max(deadline - time.monotonic(), 0.2)
            replies = self._guarded(self._session.get, key, payload=payload, timeout=left_s)
            for reply in replies:
                if reply.ok is not None:
                    return _from_json(reply.ok.payload.to_bytes())
                reason = reply.err.payload.to_bytes().decode(errors="replace")
                if reason == "Timeout":
                    raise LinkError(f"no answer from {key} within {timeout_s:g} s")
                raise LinkError(f"{key} answered: {reason}")
            if time.monotonic() >= deadline:
                allowed = ", and may this certificate call it" if self.config.tls else ""
                raise LinkError(
                    f"nobody answers {key}; is the process that serves it running{allowed}?"
                )
            time.sleep(RETRY_S)

    def declare_alive(self, process: str) -> None:
        """Show others that this process lives, until the link closes or breaks."""
        key = self.config.own_key(f"alive/{process}")
        self._declare(key, lambda session: session.liveliness().declare_token(key))

    def alive(self, process: str, timeout_s: float = 1.0) -> bool:
        """Whether a process of that name lives. One that hangs looks alive for some seconds."""
        key = self.config.own_key(f"alive/{process}")
        replies = self._guarded(self._session.liveliness().get, key, timeout=timeout_s)
        return any(reply.ok is not None for reply in replies)

    def watch_alive(self, process: str, changed: Callable[[bool], None]) -> None:
        """Call `changed`, from a thread of the link, when a process appears or goes.

        One that already lives is reported at once.
        """

        last: bool | None = None

        def on_sample(sample: zenoh.Sample) -> None:
            nonlocal last
            alive = sample.kind == zenoh.SampleKind.PUT
            # A token that is queried while it appears is reported twice.
            if alive is not last:
                last = alive
                changed(alive)

        key = self.config.own_key(f"alive/{process}")

        def declare(session: zenoh.Session) -> object:
            return session.liveliness().declare_subscriber(key, on_sample, history=True)

        self._declare(key, declare)

    @contextmanager
    def _busy_answering(self) -> Iterator[None]:
        with self._answered:
            self._answering += 1
        try:
            yield
        finally:
            with self._answered:
                self._answering -= 1
                self._answered.notify_all()

    def _subscription(self, topic: Topic[Any]) -> str:
        return subscription(topic, self.config.style, self.config.domain)

    def _subscribe(self, key: str, inbox: Latest[Any] | Stream) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                self.heard_s = time.monotonic()
                inbox.store(sample.payload.to_bytes(), sequence(sample.attachment))

        def declare(session: zenoh.Session) -> object:
            remote = zenoh.Locality.REMOTE
            return session.declare_subscriber(key, on_sample, allowed_origin=remote)

        self._declare(key, declare)

    def _declare(self, key: str, declare: Callable[[zenoh.Session], object]) -> None:
        """Declare on this session, and on each that takes its place."""
        with self._renewing:
            try:
                self._declared.append(declare(self._session))
            except zenoh.ZError as error:
                raise LinkError(f"the link cannot use {key}: {error}") from error
            self._declarations.append(declare)

    def _guarded(self, method: Callable[..., Any], key: str, *values: Any, **options: Any) -> Any:
        try:
            return method(key, *values, **options)
        except zenoh.ZError as error:
            raise LinkError(f"the link cannot use {key}: {error}") from error


def _cdr(message: Message) -> bytes:
    return message.to_cdr()


def _from_json(payload: bytes) -> JsonObject:
    if len(payload) > MAX_JSON_BYTES:
        raise MessageError(f"{len(payload)} bytes of JSON are more than {MAX_JSON_BYTES}")
    try:
        return msgspec.json.decode(payload, type=JsonObject)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise MessageError(f"{len(payload)} bytes are no JSON object: {error}") from error


def _session(config: LinkConfig) -> zenoh.Session:
    settings = zenoh.Config()
    for key, value in config.zenoh_json5().items():
        settings.insert_json5(key, value)
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        raise LinkError(_why_not_open(config, error)) from error


def _close(session: zenoh.Session) -> None:
    with suppress(zenoh.ZError):  # it gives up in time
        session.close()  # type: ignore[no-untyped-call]


def _why_not_open(config: LinkConfig, error: Exception) -> str:
    endpoints = ", ".join((*config.connect, *config.listen))
    reason = str(error).split(" at /")[0]  # the rest names a file of the library
    if config.connect and "connect" in reason:
        # Zenoh does not say why: a refused certificate looks like an absent robot.
        refused = ", or check that both sides' certificates are of one authority and that the "
        refused += "other's names that host"
        return (
            f"no answer from {', '.join(config.connect)} within {config.open_timeout_s:g} s; "
            "start the robot or simulator that listens there, or name another endpoint"
            f"{refused if config.tls else ''}"
        )
    return f"cannot open the link on {endpoints}: {reason}"
