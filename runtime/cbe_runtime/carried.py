"""What a follower carries from step to step, as JSON, where no recurrent state is part of it.

A behavior begins with an empty recurrent state. What else a follower then knows (its motion, what
its watches saw last) is small, and with it any other follower goes on exactly as this one does.
"""

from __future__ import annotations

import base64
import binascii
import math
import sys
from collections import deque
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from cbe.errors import RecordingError
from cbe_runtime.state import State

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cbe_runtime.follower import Follower

CONSTANT = frozenset({"_networks", "_route", "_robot", "_config", "_controller", "_parking"})
FLEETING = frozenset({"_asking", "asked", "_search", "_ranges_m"})
"""Empty between two steps or at the beginning of a behavior, or set anew in each step."""
OURS = ("cbe.", "cbe_runtime.")
MAX_ARRAY_BYTES = 2**20

SEARCHING = frozenset({State.LOST, State.JOINING})
BEFORE_A_START = frozenset({State.IDLE, State.ARRIVED})
"""Nothing but a start, which resets the recurrent state, leads from these to a behavior."""


class Unknown(Exception):
    """A value of a kind that is not carried."""


def take(follower: Follower) -> dict[str, Any] | None:
    """What to give another follower of the same route; None in the midst of a behavior."""
    if not is_all(follower):
        return None
    try:
        return {
            "segment": follower._behavior.segment,
            "follower": _packed(follower)["object"],
        }
    except Unknown:
        return None


def is_all(follower: Follower) -> bool:
    """Whether what is carried is all that the next step depends on."""
    if follower.state in BEFORE_A_START:
        return True
    return follower._behavior.fresh and follower.state not in SEARCHING


def give(carried: dict[str, Any], follower: Follower) -> None:
    """Put a follower into the state of another that stood at the beginning of a behavior.

    Raises:
        RecordingError: this is no such state.
    """
    try:
        segment = carried["segment"]
        if type(segment) is not int or not 0 <= segment < len(follower._route.segments):
            raise Unknown(f"segment {segment!r:.40}")
        follower._begin(segment)
        follower._search = None
        _restore(follower, carried["follower"])
    except (Unknown, KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(
            f"the recorded state is of another version or damaged ({error!r:.200}); replay with "
            "the version that recorded it"
        ) from error


def _packed(value: Any) -> Any:
    """JSON of a value; whatever is more than a plain one becomes an object of one key."""
    if value is None or (isinstance(value, bool | str | int) and not isinstance(value, Enum)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": str(value)}
    if isinstance(value, Enum):
        return {"enum": [_name(type(value)), value.value]}
    if isinstance(value, np.ndarray):
        data = base64.b64encode(value.tobytes()).decode()
        return {"array": [value.dtype.str, list(value.shape), data]}
    if isinstance(value, tuple | list | deque):
        return {type(value).__name__: [_packed(each) for each in value]}
    if is_dataclass(value):
        content = {field.name: _packed(getattr(value, field.name)) for field in fields(value)}
        return {"dataclass": [_name(type(value)), content]}
    if _name(type(value)) and hasattr(value, "__dict__"):
        return {"object": {name: _packed(getattr(value, name)) for name in _names(value)}}
    raise Unknown(type(value).__name__)


def _unpacked(packed: Any, present: Any) -> Any:
    """The value of a JSON; an object of ours is the present one with its attributes replaced."""
    if not isinstance(packed, dict):
        return packed
    ((kind, content),) = packed.items()
    match kind:
        case "float":
            return float(content)
        case "array":
            return _array(*content)
        case "tuple" | "list" | "deque":
            made = [_unpacked(each, None) for each in content]
            return deque(made, present.maxlen) if kind == "deque" else _SEQUENCES[kind](made)
        case "enum":
            return _class(content[0], Enum)(content[1])
        case "dataclass":
            cls = _class(content[0], None)
            return cls(**{name: _unpacked(each, None) for name, each in content[1].items()})
        case "object":
            _restore(present, content)
            return present
    raise Unknown(str(kind))


_SEQUENCES = {"tuple": tuple, "list": list}


def _restore(present: Any, attributes: dict[str, Any]) -> None:
    """Replace an object's attributes; none is added or left out."""
    known = _names(present)
    if known != set(attributes):
        raise Unknown(f"attributes {sorted(known ^ set(attributes))}")
    for name, packed in attributes.items():
        setattr(present, name, _unpacked(packed, getattr(present, name)))


def _names(thing: Any) -> set[str]:
    """Of the attributes that are carried; what holds networks is recurrent and begun anew."""
    return {
        name
        for name, value in vars(thing).items()
        if name not in CONSTANT | FLEETING and not hasattr(value, "_networks")
    }


def _array(dtype: str, shape: list[int], data: str) -> NDArray[Any]:
    """A copy of its own, with nothing but numbers in it."""
    if np.dtype(dtype).kind not in "biuf" or len(data) > 2 * MAX_ARRAY_BYTES:
        raise Unknown(f"array of {dtype[:20]}")
    try:
        content = base64.b64decode(data, validate=True)
    except binascii.Error as error:
        raise Unknown(str(error)) from error
    return np.frombuffer(content, dtype).reshape(shape).copy()


def _name(cls: type) -> str:
    """Of a class of ours, such as "cbe_runtime.state:State"; empty for others."""
    return f"{cls.__module__}:{cls.__qualname__}" if cls.__module__.startswith(OURS) else ""


def _class(name: str, base: type | None) -> Any:
    """A dataclass, or a subclass of `base`, of ours."""
    module, _, qualified = name.partition(":")
    found = getattr(sys.modules.get(module), qualified, None) if module.startswith(OURS) else None
    wanted = isinstance(found, type) and (issubclass(found, base) if base else is_dataclass(found))
    if not wanted:
        raise Unknown(name[:100])
    return found
