"""Every decision with all that it came from, so that it can be made again and compared."""

from __future__ import annotations

import hashlib
import math
import secrets
import zlib
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from cbe_runtime import carried, routefile
from cbe_runtime.decision import Asked, Decision
from cbe_runtime.followerconfig import FollowerConfig

if TYPE_CHECKING:
    from cbe.camera import CameraModel
    from cbe.link import Link
    from cbe_runtime.follower import Follower
    from cbe_runtime.observation import Frame, Observation, Scan
    from cbe_runtime.route import Route
    from cbe_runtime.sensors import Sensors

DECISION = "decision"
"""Name of the own key, `cbe/v1/<robot>/decision`, and of the topic in a recording."""

VERSION = 1
REPEAT_STEPS = 20
"""A robot that waits tells its state once in so many steps: from there all can be made again."""

Unsigned32 = Annotated[int, msgspec.Meta(ge=0, lt=2**32)]


@dataclass(frozen=True, slots=True)
class Seen:
    """Which frame or scan a decision saw.

    `stamp_ns` is the sender's, or minus the count of a message that could not be used;
    `received_s` by the runtime's monotonic clock; `crc` of what the follower was given: the model's
    view (64, 64, 3) uint8 or the ranges (rays,) float32, None where there was nothing to give.
    """

    stamp_ns: int
    received_s: float
    crc: Unsigned32 | None


@dataclass(frozen=True, slots=True)
class Settings:
    """What stays the same over a run: route and model by their hashes, and what is set by hand."""

    model_id: str
    route_id: str
    follower: FollowerConfig
    camera: dict[str, Any] | None
    """The camera in use, as `CameraModel.to_dict` has it."""

    @classmethod
    def of(cls, follower: Follower) -> Settings:
        """Of a follower whose camera is not known yet."""
        return cls(follower.model_id, route_id(follower._route), follower._config, None)


@dataclass(frozen=True, slots=True)
class DecisionRecord:
    """One step: what was asked and seen, what was decided, and what is carried to the next.

    `run` names one run of a runtime, whose steps count from 1; `now_s` is its monotonic time.
    `carried` is told where the next step begins a behavior (see `carried.take`).
    """

    version: int
    run: str
    step: int
    now_s: float
    asked: Asked
    frame: Seen | None
    scan: Seen | None
    decision: Decision
    settings: Settings
    carried: dict[str, Any] | None


class DecisionLog:
    """Publishes a record a step; the link drops it rather than wait for a slow reader."""

    def __init__(self, link: Link, follower: Follower, sensors: Sensors) -> None:
        self._records = link.json_publisher(DECISION)
        self._follower = follower
        self._sensors = sensors
        self._run = secrets.token_hex(8)
        self._step = 0
        self._camera: CameraModel | None = None
        self._packed = msgspec.Raw()
        self._told_step: int | None = None  # when the state that still holds was told
        self._seen: dict[str, tuple[Frame | Scan, Seen]] = {}

    def put(self, observation: Observation, now_s: float, decision: Decision) -> None:
        """Publish what was decided in the step that has just been taken at `now_s`."""
        self._step += 1
        camera = self._sensors.calibration
        if self._step == 1 or camera is not self._camera:
            self._camera = camera
            settings = Settings.of(self._follower)
            settings = replace(settings, camera=camera.to_dict() if camera else None)
            self._packed = msgspec.Raw(msgspec.json.encode(settings))
        frame, scan = observation.frame, observation.scan
        self._records.put(
            {
                "version": VERSION,
                "run": self._run,
                "step": self._step,
                "now_s": now_s,
                "asked": self._follower.asked,
                "frame": self._known("frame", frame, frame and frame.image),
                "scan": self._known("scan", scan, scan and scan.ranges_m),
                "decision": decision,
                "settings": self._packed,
                "carried": self._carried(),
            }
        )

    def _carried(self) -> dict[str, Any] | None:
        if not carried.is_all(self._follower):
            self._told_step = None
            return None
        if self._told_step is not None and self._step - self._told_step < REPEAT_STEPS:
            return None
        self._told_step = self._step
        return carried.take(self._follower)

    def _known(self, name: str, sample: Frame | Scan | None, content: Any) -> Seen | None:
        """Which sample this is; its checksum is taken once."""
        if sample is None:
            return None
        before = self._seen.get(name)
        if before is None or before[0] is not sample:
            crc = None if content is None else checksum(content)
            self._seen[name] = before = (sample, Seen(sample.stamp_ns, sample.received_s, crc))
        return before[1]


def route_id(route: Route) -> str:
    """16 hex digits naming a route's contents."""
    return hashlib.sha256(routefile.dump(route)).hexdigest()[:16]


def checksum(content: Any) -> int:
    """CRC-32 of an array's bytes."""
    return zlib.crc32(content.data if content.flags.c_contiguous else content.tobytes())


def parse(data: bytes) -> DecisionRecord:
    """A record from its JSON.

    Raises:
        msgspec.DecodeError: it is none, or of a newer kind.
    """
    return msgspec.convert(_with_infinities(msgspec.json.decode(data)), DecisionRecord)


def differing(recorded: Any, made: Any, path: str = "") -> tuple[str, Any, Any] | None:
    """The first field, by its dotted path, in which two records' values differ, and both values."""
    if hasattr(recorded, "__dataclass_fields__") and type(recorded) is type(made):
        for field in fields(recorded):
            name = f"{path}.{field.name}".lstrip(".")
            found = differing(getattr(recorded, field.name), getattr(made, field.name), name)
            if found is not None:
                return found
        return None
    return None if _same(recorded, made) else (path, recorded, made)


def _same(recorded: Any, made: Any) -> bool:
    """Bit for bit: NaN equals itself, and 0.0 is not -0.0."""
    if isinstance(recorded, float) and isinstance(made, float):
        return recorded.hex() == made.hex()
    if isinstance(recorded, tuple) and isinstance(made, tuple):
        return len(recorded) == len(made) and all(map(_same, recorded, made))
    return bool(recorded == made)


def _with_infinities(values: Any) -> Any:
    """JSON has no infinity: an age of what was never received came as null."""
    if isinstance(values, dict) and isinstance(decision := values.get("decision"), dict):
        for name in ("camera_age_s", "scan_age_s"):
            if decision.get(name, 0) is None:
                decision[name] = math.inf
    return values
