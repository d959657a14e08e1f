"""Route files: a hashed MessagePack envelope, written atomically, refused unless whole and valid.

Envelope: `{magic, version, sha256, body}`. Body, version 1: `m` model id, `c` camera, `p` network
period, `q` precisions of attractors and embeddings, `a` all attractors, `s` segments as
(embedding, steps), `t` tags. Any MessagePack reader opens both.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
from typing import TYPE_CHECKING, Annotated, TypeVar

import msgpack
import msgspec

from cbe.camera import CameraModel
from cbe.errors import CbeError, RouteError
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision, Precision, Route, Segment

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MAGIC = "cbe-route"
VERSION = 1
MAX_FILE_BYTES = 8 * 2**20
"""Days of driving; read, checked and taken apart it stays within a board's memory."""
USUAL_BYTES = 2**13
"""A drive of some minutes."""
MAX_SEGMENTS = 100_000
MAX_TAGS = 64

Checked = TypeVar("Checked")
_Text = Annotated[str, msgspec.Meta(max_length=256)]


class _Envelope(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    magic: _Text
    version: int
    sha256: Annotated[bytes, msgspec.Meta(min_length=32, max_length=32)]
    body: bytes


class _Segment(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    embedding: Annotated[bytes, msgspec.Meta(max_length=4096)]
    steps: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]


class _Camera(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    width: Annotated[int, msgspec.Meta(ge=1, le=65_535)]
    height: Annotated[int, msgspec.Meta(ge=1, le=65_535)]
    fx: float
    fy: float
    cx: float
    cy: float
    model: _Text
    distortion: Annotated[tuple[float, ...], msgspec.Meta(max_length=16)]


class _Body(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
    rename={
        "model_id": "m",
        "camera": "c",
        "network_period": "p",
        "precision": "q",
        "attractors": "a",
        "segments": "s",
        "tags": "t",
    },
):
    model_id: Annotated[bytes, msgspec.Meta(min_length=8, max_length=8)]
    camera: _Camera
    network_period: Annotated[int, msgspec.Meta(ge=1, le=2)]
    precision: tuple[AttractorPrecision, EmbeddingPrecision]
    attractors: bytes
    segments: Annotated[tuple[_Segment, ...], msgspec.Meta(min_length=1, max_length=MAX_SEGMENTS)]
    tags: Annotated[dict[_Text, _Text], msgspec.Meta(max_length=MAX_TAGS)] = {}


def dump(route: Route) -> bytes:
    """The whole file's bytes of a route."""
    camera = route.camera
    body = _Body(
        model_id=bytes.fromhex(route.model_id),
        camera=_Camera(
            camera.width,
            camera.height,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            camera.model,
            tuple(camera.distortion),
        ),
        network_period=route.network_period,
        precision=(route.precision.attractor, route.precision.embedding),
        attractors=b"".join(route.attractors),
        segments=tuple(_Segment(each.embedding, each.steps) for each in route.segments),
        tags=dict(route.tags),
    )
    packed: bytes = msgpack.packb(
        msgspec.to_builtins(body, builtin_types=(bytes,)), use_single_float=True
    )
    envelope = {
        "magic": MAGIC,
        "version": VERSION,
        "sha256": hashlib.sha256(packed).digest(),
        "body": packed,
    }
    data: bytes = msgpack.packb(envelope)
    return data


def parse(data: bytes) -> Route:
    """The route in a whole file's bytes.

    Raises:
        RouteError: the bytes are no route, damaged, of another version or out of range.
    """
    envelope = _decode(data, _Envelope)
    if envelope.magic != MAGIC:
        raise RouteError(
            f"the file is no route: its magic is {envelope.magic!r}, expected {MAGIC!r}"
        )
    if envelope.version != VERSION:
        raise RouteError(
            f"the route file has version {envelope.version}, this program reads {VERSION}; "
            "upgrade it or teach the route again"
        )
    if hashlib.sha256(envelope.body).digest() != envelope.sha256:
        raise RouteError(
            "the route file is damaged: its sha256 does not match; copy or teach it again"
        )
    body = _decode(envelope.body, _Body)
    precision = Precision(*body.precision)
    size = precision.attractor.size_bytes
    if len(body.attractors) != size * (len(body.segments) + 1):
        raise RouteError(
            f"the route file has {len(body.attractors)} bytes of attractors, expected "
            f"{size} x {len(body.segments) + 1}; teach it again"
        )
    return Route(
        model_id=body.model_id.hex(),
        camera=_camera(body.camera),
        network_period=body.network_period,
        precision=precision,
        attractors=tuple(
            body.attractors[start : start + size] for start in range(0, len(body.attractors), size)
        ),
        segments=tuple(Segment(each.embedding, each.steps) for each in body.segments),
        tags=body.tags,
    )


def load(path: Path) -> Route:
    """Read and check a route file.

    Raises:
        RouteError: it cannot be read, is too large, or `parse` refuses it.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise RouteError(
            f"cannot read the route {path}: {error.strerror}; check the path"
        ) from error
    if len(data) > MAX_FILE_BYTES:
        raise RouteError(f"{path} is larger than {MAX_FILE_BYTES} bytes; is it a route?")
    try:
        return parse(data)
    except RouteError as error:
        raise RouteError(f"{path}: {error}") from error


def save(route: Route, path: Path) -> int:
    """Write a route file so that a crash leaves the old file or the new one; returns its bytes.

    Raises:
        RouteError: the folder cannot be written.
    """
    data = dump(route)
    with _beside(path, data) as temporary:
        temporary.replace(path)
        # The rename itself is only safe once the folder is on disk too.
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return len(data)


def require_writable(path: Path) -> None:
    """Make sure before a long drive that a route of usual size can be saved there.

    Raises:
        RouteError: it cannot.
    """
    with _beside(path, bytes(USUAL_BYTES)):
        pass


@contextlib.contextmanager
def _beside(path: Path, data: bytes) -> Iterator[Path]:
    """A temporary file of these bytes in the same folder, on disk; gone at the end if still there.

    Raises:
        RouteError: it cannot be written, or what is done with it fails.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        yield temporary
    except OSError as error:
        raise RouteError(
            f"cannot write the route {path}: {error.strerror}; free space or choose another folder"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _decode(data: bytes, into: type[Checked]) -> Checked:
    """Decode straight into a type: what it does not hold is refused before anything is built."""
    try:
        return msgspec.msgpack.decode(data, type=into)
    except msgspec.ValidationError as error:
        raise RouteError(
            f"the route file does not hold a route ({error}); teach it again"
        ) from error
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise RouteError(
            f"the route file is truncated or no MessagePack ({error}); copy or teach it again"
        ) from error


def _camera(stored: _Camera) -> CameraModel:
    numbers = (stored.fx, stored.fy, stored.cx, stored.cy, *stored.distortion)
    if not all(math.isfinite(number) for number in numbers):
        raise RouteError("the route's camera has a number that is not finite; teach it again")
    # Single floats keep 7 digits: rounding gives back the decimal number that was meant.
    fx, fy, cx, cy, *distortion = (float(f"{number:.7g}") for number in numbers)
    try:
        return CameraModel(
            width=stored.width,
            height=stored.height,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            model=stored.model,
            distortion=tuple(distortion),
        )
    except CbeError as error:
        raise RouteError(f"the route's camera is unusable: {error}") from error
