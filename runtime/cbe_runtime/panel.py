"""A step of a drive as a picture: what the camera and the lidar saw, and what was decided."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cbe.errors import CbeError
from cbe.images import decode_image
from cbe.robot import Robot
from cbe_runtime.state import State

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cbe.messages import CompressedImage, Image
    from cbe_runtime.decision import Decision
    from cbe_runtime.observation import Observation

Colour = tuple[int, int, int]  # BGR

WIDTH, HEIGHT = 960, 540  # px
MARGIN = 16
TOP = 64  # of camera and scan
VIEW = 384  # px, height of both; the scan is as wide
BACKGROUND, PLATE, LINE = (30, 26, 24), (46, 40, 37), (84, 76, 70)
INK, FAINT = (240, 236, 232), (160, 150, 142)
FREE, HIT, WAYPOINT, PATH = (62, 58, 48), (214, 196, 120), (60, 170, 255), (140, 220, 150)
ALARM = (80, 80, 240)
STATES: dict[State, Colour] = {
    State.FOLLOWING: (104, 176, 72),
    State.ARRIVED: (214, 148, 70),
    State.STOPPED: (70, 70, 220),
    State.IDLE: (120, 112, 106),
    State.LOST: (176, 60, 192),
    State.JOINING: (60, 150, 230),
}
REACH_M = 4.0  # shown ahead
BEHIND_M = 1.2
FORESEEN_S = 2.0
RING_M = 1.0


@dataclass(frozen=True, slots=True)
class Scene:
    """What one picture shows; `note` is a line of warning, `when` of the time."""

    decision: Decision
    observation: Observation | None
    picture: CompressedImage | Image | None
    when: str
    note: str = ""


class Panel:
    """Draws scenes; pictures are (HEIGHT, WIDTH, 3) uint8 BGR."""

    def __init__(self, title: str, steps: Sequence[int], robot: Robot | None = None) -> None:
        """`steps` are the lengths of the route's segments."""
        self._title = title
        self._shares = np.cumsum([0.0, *steps]) / max(sum(steps), 1)
        self._robot = robot or Robot()
        turned = self._robot.scan_angle_increment_rad * np.arange(self._robot.scan_rays)
        angle = self._robot.scan_angle_min_rad + turned
        self._rays = np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (rays, 2)

    def draw(self, scene: Scene) -> NDArray[np.uint8]:
        """The picture of a scene."""
        pixels: NDArray[np.uint8] = np.full((HEIGHT, WIDTH, 3), BACKGROUND, np.uint8)
        _text(pixels, self._title, MARGIN, 40, 0.62, FAINT)
        _text(pixels, scene.when, WIDTH - MARGIN, 40, 0.62, FAINT, right=True)
        self._draw_camera(pixels, scene)
        self._draw_scan(pixels, scene)
        self._draw_route(pixels, scene)
        return pixels

    def _draw_camera(self, pixels: NDArray[np.uint8], scene: Scene) -> None:
        import cv2

        width = WIDTH - 3 * MARGIN - VIEW
        plate = pixels[TOP : TOP + VIEW, MARGIN : MARGIN + width]
        plate[:] = PLATE
        image = _rgb(scene)
        if image is None:
            _text(plate, "no picture", width // 2 - 56, VIEW // 2, 0.7, FAINT)
        else:
            scale = min(width / image.shape[1], VIEW / image.shape[0])
            size = (max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1))
            method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
            shown = cv2.resize(image[..., ::-1], size, interpolation=method)
            x, y = (width - size[0]) // 2, (VIEW - size[1]) // 2
            plate[y : y + size[1], x : x + size[0]] = shown
        _state(plate, scene.decision)
        if scene.note:
            plate[VIEW - 34 :] = (0.35 * plate[VIEW - 34 :]).astype(np.uint8)
            _text(plate, scene.note, 10, VIEW - 11, 0.52, ALARM)

    def _draw_scan(self, pixels: NDArray[np.uint8], scene: Scene) -> None:
        import cv2

        plate = np.full((VIEW, VIEW, 3), PLATE, np.uint8)
        px_per_m = VIEW / (REACH_M + BEHIND_M)

        def at(points_m: NDArray[np.float64]) -> NDArray[np.int32]:
            """Pixels (N, 2) of points (N, 2) in base_link, whose x axis points up."""
            x, y = points_m[:, 0], points_m[:, 1]
            ahead = np.stack([0.5 * VIEW - y * px_per_m, (REACH_M - x) * px_per_m], axis=-1)
            return np.rint(ahead).astype(np.int32)

        origin = at(np.zeros((1, 2)))[0].tolist()
        scan = scene.observation.scan if scene.observation else None
        if scan is not None and scan.ranges_m is not None:
            ranges = np.nan_to_num(scan.ranges_m.astype(np.float64), nan=0.0, posinf=20.0)
            points = np.array([self._robot.scan_x_m, 0.0]) + ranges[:, None] * self._rays
            laser = np.array([[self._robot.scan_x_m, 0.0]])
            cv2.fillPoly(plate, [at(np.concatenate([laser, points]))], FREE, cv2.LINE_AA)
        for ring in np.arange(RING_M, REACH_M + 2.0, RING_M):
            cv2.circle(plate, origin, round(ring * px_per_m), LINE, 1, cv2.LINE_AA)
        if scan is not None and scan.ranges_m is not None:
            for x, y in at(points[np.isfinite(scan.ranges_m)]).tolist():
                cv2.circle(plate, (x, y), 2, HIT, cv2.FILLED, cv2.LINE_AA)
        else:
            _text(plate, "no scan", VIEW // 2 - 40, VIEW // 3, 0.7, FAINT)
        decision = scene.decision
        foreseen = _arc(decision.speed_mps, decision.yaw_rate_rad_s)
        cv2.polylines(plate, [at(foreseen)], False, PATH, 3, cv2.LINE_AA)
        radius = round(self._robot.body_radius_m * px_per_m)
        cv2.circle(plate, origin, radius, INK, cv2.FILLED, cv2.LINE_AA)
        nose = at(np.array([[self._robot.body_radius_m, 0.0]]))[0].tolist()
        cv2.line(plate, origin, nose, BACKGROUND, 2, cv2.LINE_AA)
        if decision.waypoint_m is not None:
            x, y = at(np.array([decision.waypoint_m]))[0].tolist()
            cv2.circle(plate, (x, y), 7, WAYPOINT, 2, cv2.LINE_AA)
            cv2.circle(plate, (x, y), 2, WAYPOINT, cv2.FILLED, cv2.LINE_AA)
        _text(plate, f"{REACH_M:g} m", 10, 20, 0.45, FAINT)
        pixels[TOP : TOP + VIEW, WIDTH - MARGIN - VIEW : WIDTH - MARGIN] = plate

    def _draw_route(self, pixels: NDArray[np.uint8], scene: Scene) -> None:
        """The whole route as a bar with its joints, and the figures below."""
        import cv2

        decision = scene.decision
        # Its ends are round, by half its thickness.
        left, right, y = MARGIN + 6, WIDTH - MARGIN - 6, TOP + VIEW + 26
        span = right - left
        colour = STATES[decision.state]
        cv2.line(pixels, (left, y), (right, y), PLATE, 12, cv2.LINE_AA)
        segment = min(decision.segment, len(self._shares) - 2)
        begin, end = self._shares[segment : segment + 2].tolist()
        progress = min(max(decision.progress, 0.0), 1.0)
        done = left + round(span * (begin + progress * (end - begin)))
        if done > left:
            cv2.line(pixels, (left, y), (done, y), colour, 12, cv2.LINE_AA)
        for share in self._shares[1:-1].tolist():
            x = left + round(span * share)
            cv2.line(pixels, (x, y - 9), (x, y + 9), INK, 1, cv2.LINE_AA)
        words = (
            f"segment {decision.segment + 1}/{decision.segments}",
            f"progress {100 * decision.progress:.0f} %",
            f"on route {100 * decision.on_route:.0f} %",
            f"{decision.speed_mps:.2f} m/s",
            f"{math.degrees(decision.yaw_rate_rad_s):+.0f} deg/s",
            f"camera {_age(decision.camera_age_s)}, scan {_age(decision.scan_age_s)}",
        )
        x = MARGIN
        for word, room in zip(words, (160, 160, 160, 110, 120, 220), strict=True):
            _text(pixels, word, x, HEIGHT - 22, 0.5, INK)
            x += room


def _state(plate: NDArray[np.uint8], decision: Decision) -> None:
    """A badge that says what the follower is doing, and why."""
    import cv2

    words = decision.state.value + (f": {decision.reason.value}" if decision.reason else "")
    (width, _), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 2)
    colour = STATES[decision.state]
    cv2.rectangle(plate, (10, 10), (width + 30, 42), colour, cv2.FILLED, cv2.LINE_AA)
    _text(plate, words, 20, 33, 0.6, (255, 255, 255), thickness=2)


def _text(
    pixels: NDArray[np.uint8], words: str, x: int, y: int, size: float, colour: Colour,
    *, right: bool = False, thickness: int = 1,
) -> None:  # fmt: skip
    """Words that begin, or end, at pixel (x, y); ASCII only."""
    import cv2

    plain = words.encode("ascii", "replace").decode()
    if right:
        x -= cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, size, thickness)[0][0]
    cv2.putText(
        pixels, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, thickness, cv2.LINE_AA
    )


def _rgb(scene: Scene) -> NDArray[np.uint8] | None:
    """The camera's own picture, or the model's view of it where that is all there is."""
    if scene.picture is not None:
        try:
            return decode_image(scene.picture)
        except CbeError:
            return None
    frame = scene.observation.frame if scene.observation else None
    return None if frame is None else frame.image


def _arc(speed_mps: float, yaw_rate_rad_s: float) -> NDArray[np.float64]:
    """Where a command would lead (N, 2) in m, in base_link."""
    time_s = np.linspace(0.0, FORESEEN_S, 24)
    turned = yaw_rate_rad_s * time_s
    chord = speed_mps * time_s * np.sinc(0.5 * turned / math.pi)
    return np.stack([chord * np.cos(0.5 * turned), chord * np.sin(0.5 * turned)], axis=-1)


def _age(age_s: float) -> str:
    return f"{1000 * age_s:.0f} ms" if math.isfinite(age_s) else "never"
