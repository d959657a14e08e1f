"""ROS 2 recordings (MCAP) as a stream of messages, in and out."""

from __future__ import annotations

import logging
import os
import struct
from collections.abc import Container
from dataclasses import dataclass
from io import BytesIO
from typing import IO, TYPE_CHECKING, Self

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from cbe.errors import RecordingError
from cbe.messages import MESSAGE_TYPES
from cbe_runtime.jsonschemas import JSON_TYPES
from cbe_runtime.mcaprecords import DAMAGE, Damaged, records

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import TracebackType

logger = logging.getLogger(__name__)

MAX_DESCRIPTION_BYTES = 256 * 2**10
MAX_TOPIC = 256
CHUNK_BYTES = 128 * 2**10
"""What a power cut can cost: a few seconds of one camera."""

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, time of recording, time of sending


@dataclass(frozen=True, slots=True)
class Recorded:
    """One recorded message: its topic, type, CDR or JSON bytes and time of recording."""

    topic: str
    type_name: str
    data: bytes
    log_time_ns: int


def read(path: Path, types: Container[str] = MESSAGE_TYPES) -> Iterator[Recorded]:
    """The messages of some known types of a recording, in the file's order, a chunk at a time.

    A file that was cut short yields what it holds, with a warning.

    Raises:
        RecordingError: the file cannot be read, is no MCAP or holds no message of these types.
    """
    count = 0
    try:
        with path.open("rb") as file:
            for message in _messages(file, path.stat().st_size, types):
                count += 1
                yield message
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}; check the path") from error
    except Damaged as damaged:
        if count == 0:
            raise RecordingError(
                f"{path} is no readable MCAP recording ({damaged}); check the file"
            ) from damaged
        logger.warning(
            "%s is truncated or damaged (%s); going on with its first %d messages",
            path,
            damaged,
            count,
        )
    if count == 0:
        raise RecordingError(
            f"{path} holds no ROS 2 message in CDR of a known type ({', '.join(MESSAGE_TYPES)}); "
            "record a camera topic"
        )


def _messages(file: IO[bytes], size: int, types: Container[str]) -> Iterator[Recorded]:
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    entries = records(file, size)
    while True:
        try:
            opcode, content = next(entries, (Opcode.DATA_END, memoryview(b"")))
            if opcode == Opcode.DATA_END:
                return
            if opcode == Opcode.MESSAGE:
                channel_id, _, log_time_ns, _ = _MESSAGE.unpack_from(content)
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(_described(content))
                schemas.pop(schema.id, None)
                if schema.name in types:
                    schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_described(content))
                channels.pop(channel.id, None)
                if len(channel.topic) > MAX_TOPIC:
                    raise Damaged(f"a topic's name has {len(channel.topic)} characters")
                type_name = schemas.get(channel.schema_id)
                if type_name and channel.message_encoding == _encoding(type_name):
                    channels[channel.id] = (channel.topic, type_name)
        except DAMAGE as error:
            raise Damaged(str(error)[:200] or type(error).__name__) from error
        if opcode == Opcode.MESSAGE and channel_id in channels:
            data = bytes(content[_MESSAGE.size :])
            yield Recorded(*channels[channel_id], data, log_time_ns)


def _encoding(type_name: str) -> str:
    return "json" if type_name in JSON_TYPES else "cdr"


def _described(content: memoryview) -> ReadDataStream:
    if len(content) > MAX_DESCRIPTION_BYTES:
        raise Damaged(f"a schema or channel has {len(content)} bytes")
    return ReadDataStream(BytesIO(content))


class Closing:
    """A writer that a `with` block closes."""

    def close(self) -> None:
        """Finish what is written."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close; an end that does not fit on a full disk does not hide the first error."""
        try:
            self.close()
        except OSError:
            if error is None:
                raise


class Recorder(Closing):
    """Writes a recording: profile ros2, schemas in ros2msg or jsonschema, zstd chunks."""

    def __init__(self, path: Path, chunk_bytes: int = CHUNK_BYTES, new: bool = False) -> None:
        """Create the file; a `new` one never takes another's place.

        Raises:
            RecordingError: it cannot be written.
        """
        self._path = path
        try:
            self._file = path.open("xb" if new else "wb")
        except OSError as error:
            raise RecordingError(
                f"cannot write {path}: {error.strerror}; choose another path"
            ) from error
        self._writer = Writer(self._file, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="cbe")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.count = 0

    def write(self, message: Recorded) -> None:
        """Append a message.

        Raises:
            RecordingError: the disk is full or gone.
        """
        try:
            channel = self._channel(message.topic, message.type_name)
            self._writer.add_message(
                channel, message.log_time_ns, message.data, publish_time=message.log_time_ns
            )
        except OSError as error:
            raise self._broken(error) from error
        self.count += 1

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell()

    def flush(self, sync: bool = False) -> None:
        """Hand over to the system what is finished; with `sync`, on to the disk.

        Raises:
            RecordingError: the disk is full or gone.
        """
        try:
            self._file.flush()
            if sync:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise self._broken(error) from error

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def _broken(self, error: OSError) -> RecordingError:
        return RecordingError(f"cannot go on writing {self._path}: {error.strerror}; free space")

    def _channel(self, topic: str, type_name: str) -> int:
        if topic not in self._channels:
            if type_name not in self._schemas:
                described = (
                    ("jsonschema", JSON_TYPES[type_name])
                    if type_name in JSON_TYPES
                    else ("ros2msg", MESSAGE_TYPES[type_name].definition.encode())
                )
                self._schemas[type_name] = self._writer.register_schema(type_name, *described)
            self._channels[topic] = self._writer.register_channel(
                topic, _encoding(type_name), self._schemas[type_name]
            )
        return self._channels[topic]
