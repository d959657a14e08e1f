"""ROS 2 recordings (MCAP) as a stream of messages, in and out."""

from __future__ import annotations

import logging
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from mcap import stream_reader
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, DataEnd, Message, Schema
from mcap.writer import CompressionType, Writer

from cbe.errors import RecordingError
from cbe.messages import MESSAGE_TYPES

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import TracebackType

logger = logging.getLogger(__name__)

MAX_RECORD_BYTES = 256 * 2**20
CHUNK_BYTES = 128 * 2**10
"""What a power cut can cost: a few seconds of one camera."""

# zstandard's error derives from Exception alone, and a cut record shows in any of the others.
DAMAGE = (McapError, struct.error, ValueError, EOFError, stream_reader.zstandard.ZstdError)  # type: ignore[attr-defined]


@dataclass(frozen=True, slots=True)
class Recorded:
    """One recorded message: its topic, ROS type, CDR bytes and time of recording."""

    topic: str
    type_name: str
    data: bytes
    log_time_ns: int


def read(path: Path) -> Iterator[Recorded]:
    """The messages of known types of a recording, in the file's order, a chunk at a time.

    A file that was cut short yields what it holds, with a warning.

    Raises:
        RecordingError: the file cannot be read, is no MCAP or holds no message of a known type.
    """
    count = 0
    try:
        with path.open("rb") as file:
            reader = stream_reader.StreamReader(
                file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES
            )
            for message in _messages(reader):
                count += 1
                yield message
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}; check the path") from error
    except _Damaged as damaged:
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


class _Damaged(Exception):
    """The stream ends or breaks before its end mark."""


def _messages(reader: stream_reader.StreamReader) -> Iterator[Recorded]:
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    for record in _records(reader):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            type_name = schemas.get(record.schema_id)
            if record.message_encoding == "cdr" and type_name in MESSAGE_TYPES:
                channels[record.id] = (record.topic, type_name)
        elif isinstance(record, Message) and record.channel_id in channels:
            yield Recorded(*channels[record.channel_id], record.data, record.log_time)


def _records(reader: stream_reader.StreamReader) -> Iterator[object]:
    """Records up to the end of the data section, chunks opened."""
    try:
        for record in reader.records:
            if isinstance(record, DataEnd):
                return
            if isinstance(record, Chunk):
                yield from stream_reader.breakup_chunk(record, validate_crc=True)
            else:
                yield record
    except DAMAGE as error:
        raise _Damaged(str(error) or type(error).__name__) from error


class Recorder:
    """Writes a recording: profile ros2, schemas in ros2msg, zstd chunks."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            RecordingError: it cannot be written.
        """
        self._path = path
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise RecordingError(
                f"cannot write {path}: {error.strerror}; choose another path"
            ) from error
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
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
            raise RecordingError(
                f"cannot go on writing {self._path}: {error.strerror}; free space"
            ) from error
        self.count += 1

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        """The recorder itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close; an index that does not fit on a full disk does not hide the first error."""
        try:
            self.close()
        except OSError:
            if error is None:
                raise

    def _channel(self, topic: str, type_name: str) -> int:
        if topic not in self._channels:
            if type_name not in self._schemas:
                self._schemas[type_name] = self._writer.register_schema(
                    type_name, "ros2msg", MESSAGE_TYPES[type_name].definition.encode()
                )
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[type_name]
            )
        return self._channels[topic]
