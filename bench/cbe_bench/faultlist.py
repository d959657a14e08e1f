"""The faults that are injected: what befalls messages, processor and process, and for how long."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cbe.errors import ConfigError
from cbe.images import compress, raw
from cbe.messages import CompressedImage, Image, LaserScan
from cbe_bench.faultlink import CLEAR, Lane

STRUCK_S = 2.0
"""A fault that strikes mid-drive is healed after this long."""
JUMP_NS = 3_600_000_000_000


@dataclass(frozen=True, slots=True)
class Shot:
    """What the camera takes: (height, width, 3) uint8 RGB."""

    image: NDArray[np.uint8]
    stamp_ns: int

    def message(self) -> CompressedImage:
        """As the robot publishes it."""
        return compress(self.image, self.stamp_ns)


@dataclass(frozen=True, slots=True)
class Load:
    """Waits for the processor, before a tick and within it: exponential, with a few long ones."""

    mean_s: float
    stalled: float  # share of waits that last up to:
    stall_s: float

    def wait_s(self, rng: np.random.Generator) -> float:
        """The next wait."""
        usual, stalled, long = rng.exponential(self.mean_s), rng.random(), rng.random()
        return float(usual + (stalled < self.stalled) * long * self.stall_s)


SpoilImage = Callable[[Shot, Shot, np.random.Generator], CompressedImage | Image]
"""From the shot just taken and the last one before the fault."""
SpoilScan = Callable[[LaserScan], LaserScan]


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault at one level.

    It is there from the start, or strikes once mid-drive for `lasts_s`. `must_stop` says that the
    robot may not drive on meanwhile, `raw` that the robot publishes raw images in that episode.
    """

    name: str
    level: str
    camera: Lane = CLEAR
    scan: Lane = CLEAR
    commands: Lane = CLEAR
    spoil_image: SpoilImage | None = None
    spoil_scan: SpoilScan | None = None
    jump_ns: int = 0  # of the sensors' stamps
    load: Load | None = None
    pauses: bool = False  # the follower's process is stopped
    lasts_s: float = math.inf
    must_stop: bool = False
    raw: bool = False

    @property
    def strikes(self) -> bool:
        """Whether it comes mid-drive and goes again."""
        return math.isfinite(self.lasts_s)


NONE = Fault("none", "")


def _painted(colour: int) -> SpoilImage:
    def spoil(shot: Shot, _last: Shot, _rng: np.random.Generator) -> CompressedImage:
        return replace(shot, image=np.full_like(shot.image, colour)).message()

    return spoil


def _frozen(_shot: Shot, last: Shot, _rng: np.random.Generator) -> CompressedImage:
    return last.message()


def _hanging(shot: Shot, last: Shot, _rng: np.random.Generator) -> CompressedImage:
    return replace(shot, image=last.image).message()


def _half(shot: Shot, _last: Shot, _rng: np.random.Generator) -> CompressedImage:
    image = shot.image.copy()
    image[:, : image.shape[1] // 2] = 0
    return replace(shot, image=image).message()


def _cropped(shot: Shot, _last: Shot, _rng: np.random.Generator) -> CompressedImage:
    return replace(shot, image=np.ascontiguousarray(shot.image[::2])).message()


def _truncated(shot: Shot, _last: Shot, _rng: np.random.Generator) -> CompressedImage:
    message = shot.message()
    return replace(message, data=message.data[: len(message.data) // 2])


def _flipped(shot: Shot, _last: Shot, rng: np.random.Generator) -> CompressedImage:
    message = shot.message()
    data = message.data.copy()
    struck = rng.integers(len(data) // 2, len(data) - 2, 10)  # behind the headers
    data[struck] ^= rng.integers(1, 256, len(struck)).astype(np.uint8)
    return replace(message, data=data)


def _unknown(shot: Shot, _last: Shot, _rng: np.random.Generator) -> Image:
    return replace(raw(shot.image, shot.stamp_ns), encoding="yuv422_yuy2")


def _swapped(shot: Shot, _last: Shot, _rng: np.random.Generator) -> Image:
    return replace(raw(shot.image, shot.stamp_ns), encoding="bgr8")


def _filled(range_m: float) -> SpoilScan:
    return lambda scan: replace(scan, ranges_m=np.full_like(scan.ranges_m, range_m))


def _in_degrees(scan: LaserScan) -> LaserScan:
    degrees = math.degrees(1.0)
    return replace(
        scan,
        angle_min_rad=degrees * scan.angle_min_rad,
        angle_max_rad=degrees * scan.angle_max_rad,
        angle_increment_rad=degrees * scan.angle_increment_rad,
    )


def _camera(level: str, spoil: SpoilImage, *, stops: bool = True, raw: bool = False) -> Fault:
    return Fault(
        "camera", level, spoil_image=spoil, lasts_s=STRUCK_S, must_stop=stops, raw=raw
    )  # fmt: skip


def _scan(level: str, spoil: SpoilScan) -> Fault:
    return Fault("scan", level, spoil_scan=spoil, lasts_s=STRUCK_S, must_stop=True)


def _late(name: str, level: str, late_s: float, jitter_s: float = 0.0) -> Fault:
    lane = Lane(late_s=late_s, jitter_s=jitter_s)
    return Fault(name, level, camera=lane, scan=lane)


_GONE, _HELD = Lane(lost=1.0), Lane(held=True)

FAULTS: tuple[Fault, ...] = (
    *(Fault("frame-loss", f"{share:.0%}", camera=Lane(lost=share)) for share in (0.1, 0.3, 0.5)),
    *(_late("latency", f"{ms} ms", 1e-3 * ms) for ms in (50, 100, 200, 300)),
    *(_late("jitter", f"0 to {ms} ms", 0.0, 1e-3 * ms) for ms in (100, 300)),
    *(Fault("command-latency", f"{ms} ms", commands=Lane(late_s=1e-3 * ms)) for ms in (100, 200)),
    Fault("reordering", "20%", camera=Lane(overtaken=0.2), scan=Lane(overtaken=0.2)),
    Fault("duplication", "30%", camera=Lane(doubled=0.3), scan=Lane(doubled=0.3)),
    _camera("frozen", _frozen),
    _camera("hanging", _hanging),
    _camera("black", _painted(0)),
    _camera("white", _painted(255)),
    _camera("half-occluded", _half),
    _camera("wrong-size", _cropped),
    _camera("wrong-encoding", _unknown, raw=True),
    _camera("swapped-colours", _swapped, stops=False, raw=True),
    _camera("truncated", _truncated),
    _camera("flipped-bytes", _flipped, stops=False),
    Fault("camera", "dead", camera=_GONE, lasts_s=STRUCK_S, must_stop=True),
    _scan("nan", _filled(math.nan)),
    _scan("inf", _filled(math.inf)),
    _scan("negative", _filled(-1.0)),
    _scan("empty", lambda scan: replace(scan, ranges_m=scan.ranges_m[:0])),
    _scan("angles-in-degrees", _in_degrees),
    _scan("angles-too-wide", lambda scan: replace(scan, angle_max_rad=1.2 * scan.angle_max_rad)),
    Fault("scan", "dead", scan=_GONE, lasts_s=STRUCK_S, must_stop=True),
    Fault("stamps", "+1 h", jump_ns=JUMP_NS, lasts_s=STRUCK_S),
    Fault("stamps", "-1 h", jump_ns=-JUMP_NS, lasts_s=STRUCK_S),
    Fault("link", "dead", _GONE, _GONE, _GONE, lasts_s=STRUCK_S, must_stop=True),
    Fault("link", "stalled", _HELD, _HELD, _HELD, lasts_s=STRUCK_S, must_stop=True),
    Fault("commands", "30% lost", commands=Lane(lost=0.3)),
    Fault("commands", "rejected", commands=_GONE, lasts_s=STRUCK_S, must_stop=True),
    # Several times what a fair scheduler makes of one and of two processes that never sleep.
    Fault("cpu", "one neighbour", load=Load(0.005, 0.01, 0.1)),
    Fault("cpu", "two neighbours", load=Load(0.015, 0.03, 0.25)),
    *(
        Fault("pause", f"{s:g} s", _HELD, _HELD, pauses=True, lasts_s=s, must_stop=s >= 1.0)
        for s in (0.5, 1.0, 3.0)
    ),
)


def chosen(names: Sequence[str]) -> tuple[Fault, ...]:
    """The faults of these names, "camera" or "camera:black"; all where none is named.

    Raises:
        ConfigError: there is none of that name.
    """
    if not names:
        return FAULTS
    found = [f for f in FAULTS if f.name in names or f"{f.name}:{f.level}" in names]
    known = {f.name for f in FAULTS} | {f"{f.name}:{f.level}" for f in FAULTS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(f"unknown faults {', '.join(unknown)}; known: {', '.join(sorted(known))}")
    return tuple(found)
