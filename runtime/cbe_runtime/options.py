"""Command-line options that several commands share, and their values from a TOML file."""

from __future__ import annotations

import argparse
import re
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec

from cbe.camera import CameraModel
from cbe.errors import CameraError, ConfigError
from cbe.linkconfig import LOOPBACK, LinkConfig, loopback
from cbe.linkoptions import add_security, security
from cbe.topics import KeyStyle
from cbe_runtime.followerconfig import FollowerConfig
from cbe_runtime.networks import PACKAGED_MODELS
from cbe_runtime.route import AttractorPrecision, EmbeddingPrecision

TABLES = ("camera", "follower")
UNSTORED = ("help", "config")
"""Options that mean nothing in a file."""

MAX_TOML_BYTES = 2**16
MAX_DOTS = 100
"""In a line: time and memory for a key with many grow with their square."""
MAX_ARGUMENTS = 200
MAX_VALUE = 1_000
MAX_INT = 2**63
_KEY = re.compile("[A-Za-z][A-Za-z0-9_-]*")


def add_link(parser: argparse.ArgumentParser) -> None:
    """--connect, --listen, --robot, --domain, --key-style, and those of `add_security`."""
    group = parser.add_argument_group("link")
    group.add_argument(
        "--connect",
        metavar="ENDPOINT",
        action="append",
        help=f"Zenoh endpoint to connect to; may be repeated (default {LOOPBACK})",
    )
    group.add_argument(
        "--listen",
        metavar="ENDPOINT",
        action="append",
        help="Zenoh endpoint to listen on as the hub of the others; may be repeated",
    )
    group.add_argument(
        "--robot", default="robot", help="name in the keys cbe/v1/<robot>/... (default robot)"
    )
    group.add_argument(
        "--domain", type=int, default=0, help="ROS domain, for the key style rmw_zenoh (default 0)"
    )
    group.add_argument(
        "--key-style",
        choices=[style.value for style in KeyStyle],
        default=KeyStyle.RMW_ZENOH.value,
        help="keys of ROS 2 nodes on rmw_zenoh (default), or bare names as "
        "zenoh-bridge-ros2dds uses",
    )
    add_security(parser)


def link_config(options: argparse.Namespace) -> LinkConfig:
    """The link that these options ask for.

    Raises:
        ConfigError: an endpoint or name is malformed, or certificates are missing.
    """
    style = KeyStyle(options.key_style)
    names: dict[str, Any] = {"robot": options.robot, "domain": options.domain, "style": style}
    names |= security(options)
    if not options.listen:
        return LinkConfig(connect=tuple(options.connect or (loopback(names.get("tls")),)), **names)
    return LinkConfig(
        mode="router",
        connect=tuple(options.connect or ()),
        listen=tuple(options.listen),
        **names,
    )


def add_model(parser: argparse.ArgumentParser) -> None:
    """--model."""
    parser.add_argument(
        "--model",
        type=Path,
        default=PACKAGED_MODELS,
        metavar="DIR",
        help="folder with a model's ONNX files (default: the shipped model)",
    )


def add_camera(parser: argparse.ArgumentParser) -> None:
    """--camera."""
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="TOML file with the camera's width, height, fx, fy, cx, cy [, model, distortion] in "
        "pixels, in place of camera_info",
    )


def add_precision(parser: argparse.ArgumentParser) -> None:
    """--attractors, --embeddings."""
    parser.add_argument(
        "--attractors",
        type=AttractorPrecision,
        choices=list(AttractorPrecision),
        default=AttractorPrecision.U8,
        help="how a route stores attractors (default u8)",
    )
    parser.add_argument(
        "--embeddings",
        type=EmbeddingPrecision,
        choices=list(EmbeddingPrecision),
        default=EmbeddingPrecision.F16,
        help="how a route stores embeddings (default f16)",
    )


def read_camera(path: Path | None) -> CameraModel | None:
    """The camera of a TOML file.

    Raises:
        ConfigError: the file is no TOML or no camera.
    """
    return None if path is None else camera_of(read_toml(path), path)


def camera_of(values: dict[str, Any], path: Path) -> CameraModel:
    """The camera of a TOML table.

    Raises:
        ConfigError: the values describe none.
    """
    _require_table("camera", values, path)
    try:
        return CameraModel.from_dict(values)
    except CameraError as error:
        raise ConfigError(f"{path} holds no usable camera: {error}") from error


def follower_config(values: dict[str, Any], path: Path) -> FollowerConfig:
    """The follower's settings of a TOML table.

    Raises:
        ConfigError: a key is unknown or a value out of range.
    """
    _require_table("follower", values, path)
    known = [field.name for field in fields(FollowerConfig)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ConfigError(
            f"{path}: [follower] has unknown {str(unknown)[:200]}; known: {', '.join(known)}"
        )
    for name, value in values.items():
        if type(value) not in (int, float) or not 0 < value < MAX_INT:
            raise ConfigError(f"{path}: {name} in [follower] must be a positive, finite number")
    try:
        return msgspec.convert(values, FollowerConfig)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: [follower] is wrong: {error}") from error


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file's values.

    Raises:
        ConfigError: it cannot be read, is too large or is no TOML.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_TOML_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}; check the path") from error
    if len(data) > MAX_TOML_BYTES:
        raise ConfigError(f"{path} has more than {MAX_TOML_BYTES} bytes; is it a configuration?")
    if any(line.count(b".") > MAX_DOTS for line in data.splitlines()):
        raise ConfigError(f"{path} has a line with more than {MAX_DOTS} dots; split it")
    try:
        return tomllib.loads(data.decode())
    except (ValueError, RecursionError) as error:  # no TOML, or no UTF-8
        raise ConfigError(f"{path} is no TOML file: {str(error)[:200]}") from error


def _require_table(name: str, values: object, path: Path) -> None:
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: {name} must be a table, [{name}]")


def arguments_of(values: dict[str, Any], path: Path) -> list[str]:
    """A TOML file's keys as the command-line arguments they stand for, checked like any other.

    Raises:
        ConfigError: a value is of a kind that no option takes.
    """
    arguments: list[str] = []
    for key, value in values.items():
        if key in TABLES:
            continue
        if key in UNSTORED or not _KEY.fullmatch(key):
            raise ConfigError(f"{path}: {key[:40]!r} is no option that a file may hold")
        option = f"--{key.replace('_', '-')}"
        many = value if isinstance(value, list) else [value]
        if value is True:
            arguments.append(option)
        elif value is not False:
            if not all(_is_plain(each) for each in many):
                raise ConfigError(f"{path}: {key} holds nothing that {option} takes")
            arguments.extend(f"{option}={each}" for each in many)
    if len(arguments) > MAX_ARGUMENTS:
        raise ConfigError(f"{path} has {len(arguments)} values; expected {MAX_ARGUMENTS} at most")
    return arguments


def _is_plain(value: object) -> bool:
    """Whether a value could stand on a command line."""
    if isinstance(value, str):
        return len(value) <= MAX_VALUE and value.isprintable()
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return -MAX_INT < value < MAX_INT  # nor NaN
