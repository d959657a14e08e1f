"""A robot's place on its route in a small file, so that a restarted runtime finds it again."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Annotated

import msgspec

from cbe_runtime.decisionlog import route_id
from cbe_runtime.joining import Whereabouts
from cbe_runtime.state import State

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Self

    from cbe_runtime.decision import Decision
    from cbe_runtime.follower import Follower
    from cbe_runtime.route import Route

logger = logging.getLogger(__name__)

SUFFIX = ".place"
EVERY_STEPS = 10
MAX_BYTES = 1_000

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class _Kept(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the file holds, as JSON; `route` is the hash that names the route."""

    route: str
    segment: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
    progress: Share
    arrived: bool


class Bookmark:
    """Keeps the place of a robot while it follows its route; a context manager.

    Written once a second and at each joint, whole or not at all, by a thread of its own: a slow
    disk never holds up the loop. Nothing is synced to the disk: after a power cut the file may be
    empty, and the robot is then looked for everywhere.
    """

    def __init__(self, path: Path, route: Route) -> None:
        self._path, self._segments = path, len(route.segments)
        self._route_id = route_id(route)
        self._slot: _Kept | None = None
        self._filled = threading.Condition()
        self._ended = False
        self._steps = 0
        self._last: _Kept | None = None
        self._thread = threading.Thread(target=self._write, name="bookmark", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        with self._filled:
            self._ended = True
            self._filled.notify()
        self._thread.join(timeout=1.0)

    def start(self, follower: Follower) -> None:
        """Start a follower where its predecessor was: at the beginning if that never set out."""
        try:
            kept = self._read()
        except (OSError, msgspec.DecodeError) as error:
            logger.warning("%s is unreadable (%s): looking everywhere", self._path, error)
            follower.relocalise()
            return
        if kept is None or kept.route != self._route_id or kept.arrived:
            follower.start()
        elif kept.segment >= self._segments:
            follower.relocalise()
        else:
            logger.info("resuming in segment %d at %.0f %%", kept.segment, 100.0 * kept.progress)
            follower.relocalise(Whereabouts(kept.segment, kept.progress, 0.0))

    def keep(self, decision: Decision) -> None:
        """Take note of a step."""
        self._steps += 1
        if decision.state not in {State.FOLLOWING, State.ARRIVED}:
            return
        progress = min(max(decision.progress, 0.0), 1.0)
        arrived = decision.state is State.ARRIVED
        kept = _Kept(self._route_id, decision.segment, progress, arrived)
        last = self._last
        joint = last is None or (last.segment, last.arrived) != (kept.segment, kept.arrived)
        if not joint and self._steps < EVERY_STEPS:
            return
        self._steps, self._last = 0, kept
        with self._filled:
            self._slot = kept
            self._filled.notify()

    def _read(self) -> _Kept | None:
        """What was kept; None where nothing was."""
        try:
            with self._path.open("rb") as file:
                data = file.read(MAX_BYTES)
        except FileNotFoundError:
            return None
        return msgspec.json.decode(data, type=_Kept)

    def _write(self) -> None:
        warned = False
        while True:
            with self._filled:
                self._filled.wait_for(lambda: self._slot is not None or self._ended)
                kept, self._slot = self._slot, None
            if kept is None:
                return
            beside = self._path.with_name(f"{self._path.name}.new")
            try:
                beside.write_bytes(msgspec.json.encode(kept))
                beside.replace(self._path)
            except OSError as error:
                if not warned:
                    logger.warning("cannot keep the place in %s: %s", self._path, error)
                warned = True
