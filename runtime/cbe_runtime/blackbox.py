"""A black box: a ring of recordings in a folder that holds the last minutes, whatever happens."""

from __future__ import annotations

import fcntl
import logging
import re
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from cbe.errors import RecordingError
from cbe.messages import MESSAGE_TYPES, CameraInfo
from cbe_runtime import mcapfile
from cbe_runtime.jsonschemas import JSON_TYPES
from cbe_runtime.mcapfile import Closing, Recorded, Recorder

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

logger = logging.getLogger(__name__)

SEGMENT_S = 20.0
"""A file's length; what is too old goes a file at a time."""
CHUNK_BYTES = 32 * 2**10
"""What a kill can cost: less than a second, even of a robot whose camera is dead."""
SYNC_S = 5.0
"""What a power cut can cost, besides."""
SHARES = 8
"""A file takes at most this share of the disk space allowed."""

_NAME = re.compile(r"(?P<number>\d{8})-(?P<began>\d{8}T\d{6})\.mcap")
_TIME = "%Y%m%dT%H%M%S"


@dataclass(frozen=True, slots=True)
class RingConfig:
    """How much is kept: the last `keep_s` seconds, in `max_bytes` at most."""

    keep_s: float = 300.0
    max_bytes: int = 512 * 2**20


class Ring(Closing):
    """Writes to numbered files of `SEGMENT_S`, each whole by itself, and removes the oldest.

    Files of earlier runs are part of the ring. A full disk costs the oldest file first.
    """

    def __init__(self, folder: Path, config: RingConfig | None = None) -> None:
        """Begin a file.

        Raises:
            RecordingError: the folder cannot be written, or is another black box's at present.
        """
        self._folder = folder
        self._config = config or RingConfig()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = (folder / ".lock").open("w")
        except OSError as error:
            raise RecordingError(
                f"cannot use {folder} for a black box: {error.strerror}; name a folder that can "
                "be written"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise RecordingError(
                f"{folder} is in use by another black box; stop that one or name another folder"
            ) from error
        present = segments(folder)
        self._number = int(present[-1].name[:8]) + 1 if present else 1
        self._calibration: Recorded | None = None
        self._finished = 0
        self._began_s = self._synced_s = 0.0
        self._recorder = self._begin()

    @property
    def count(self) -> int:
        """Messages written by this run."""
        return self._finished + self._recorder.count

    def write(self, message: Recorded) -> None:
        """Append a message.

        Raises:
            RecordingError: the disk is gone, or full of other things.
        """
        if message.type_name == CameraInfo.TYPE:
            self._calibration = message
        full = self._recorder.size > self._config.max_bytes // SHARES
        if full or time.monotonic() - self._began_s > SEGMENT_S:
            self._recorder = self._next()
        try:
            self._recorder.write(message)
        except RecordingError:
            self._recorder = self._next(make_room=True)
            self._recorder.write(message)

    def flush(self) -> None:
        """Hand over to the system what is finished, and to the disk now and then.

        Raises:
            RecordingError: the disk is gone, or full of other things.
        """
        sync = time.monotonic() - self._synced_s > SYNC_S
        try:
            self._recorder.flush(sync)
        except RecordingError:
            self._recorder = self._next(make_room=True)
        if sync:
            self._synced_s = time.monotonic()

    def close(self) -> None:
        """Finish the file."""
        try:
            self._recorder.close()
        finally:
            self._lock.close()

    def _next(self, make_room: bool = False) -> Recorder:
        """Finish the file and begin another; to `make_room`, remove the oldest in any case."""
        self._finished += self._recorder.count
        with suppress(OSError):  # without its index a file can still be read
            self._recorder.close()
        self._trim(make_room)
        return self._begin()

    def _begin(self) -> Recorder:
        name = f"{self._number:08d}-{datetime.now(UTC).strftime(_TIME)}.mcap"
        self._number += 1
        self._began_s = self._synced_s = time.monotonic()
        self._trim()
        recorder = Recorder(self._folder / name, CHUNK_BYTES, new=True)
        if self._calibration is not None:  # a file is of use by itself
            recorder.write(self._calibration)
        return recorder

    def _trim(self, make_room: bool = False) -> None:
        """Remove what is too old or too much."""
        kept_s, kept_bytes = 0.0, 0
        files = segments(self._folder)
        for path in reversed(files):
            try:
                about = path.stat()
            except OSError:
                continue
            kept_bytes += about.st_size
            too_much = kept_bytes > self._config.max_bytes * (SHARES - 1) // SHARES
            if kept_s > self._config.keep_s or too_much or (make_room and path == files[0]):
                logger.debug("removing %s", path)
                path.unlink(missing_ok=True)
            kept_s += _length_s(path.name, about.st_mtime)


def segments(folder: Path) -> list[Path]:
    """The files of a black box, the oldest first."""
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


def read(path: Path) -> Iterator[Recorded]:
    """All messages of a recording, or of a black box's files one after the other.

    Raises:
        RecordingError: nothing can be read.
    """
    types = (*MESSAGE_TYPES, *JSON_TYPES)
    if not path.is_dir():
        yield from mcapfile.read(path, types)
        return
    found = False
    for each in segments(path):
        try:
            for message in mcapfile.read(each, types):
                found = True
                yield message
        except RecordingError as error:  # one that was killed before its first chunk, mostly
            logger.warning("left out a file: %s", error)
    if not found:
        raise RecordingError(f"{path} holds no recording; name a black box's folder or a file")


def _length_s(name: str, ended_s: float) -> float:
    """How long a file lasts, by its name and the time it was written at; clocks may jump."""
    match = _NAME.fullmatch(name)
    assert match is not None
    try:
        began_s = datetime.strptime(match["began"], _TIME).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return SEGMENT_S
    return min(max(ended_s - began_s, 1.0), SEGMENT_S)
