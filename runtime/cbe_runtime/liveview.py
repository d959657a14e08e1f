"""Shows what is on the link to Foxglove or Lichtblick; it only listens and never sends to it."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

import msgspec

from cbe import topics
from cbe.errors import ConfigError, MessageError
from cbe.messages import MESSAGE_TYPES, CompressedImage, Image, LaserScan
from cbe.robot import Robot
from cbe_runtime.jsonschemas import JSON_TYPES
from cbe_runtime.record import OWN

if TYPE_CHECKING:
    from threading import Event

    from cbe.inbox import Sample
    from cbe.link import Link

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
POLL_S = 0.03
CAPACITY = 16
"""Messages a topic may wait here; viewers that cannot keep up lose the oldest."""
BACKLOG = 64
STATIC_S = 1.0
ALARMS = "/cbe/alarms"
SCENE = "/cbe/scene"
TRANSFORMS = "/tf"
BASE = "base_link"
ALARMING = frozenset({"STOPPED", "LOST", "EXITED"})


class LiveView:
    """A Foxglove WebSocket server of a link's topics, of alarms and of a scene round the robot."""

    def __init__(self, link: Link, host: str, port: int, unstamped: bool = False) -> None:
        """Subscribe, and listen at `host`; port 0 takes a free one.

        Raises:
            ConfigError: the extra `view` is not installed, or the port cannot be had.
        """
        try:
            import foxglove
            from foxglove.channels import FrameTransformsChannel, LogChannel, SceneUpdateChannel
        except ImportError as error:
            raise ConfigError(
                "a view needs the extra `view`: pip install 'cbe[view]' (foxglove-sdk)"
            ) from error
        self._context = context = foxglove.Context()  # dropped, it would close its channels
        commands = topics.CMD_VEL_UNSTAMPED if unstamped else topics.CMD_VEL
        wanted = (
            topics.CAMERA,
            topics.CAMERA_RAW,
            topics.CAMERA_INFO,
            topics.SCAN,
            topics.ODOM,
            commands,
        )
        self._streams = [
            (
                topic.message.TYPE,
                link.stream(topic, CAPACITY),
                foxglove.Channel(
                    f"/{topic.name}",
                    message_encoding="cdr",
                    schema=foxglove.Schema(
                        name=topic.message.TYPE,
                        encoding="ros2msg",
                        data=MESSAGE_TYPES[topic.message.TYPE].definition.encode(),
                    ),
                    context=context,
                ),
            )
            for topic in wanted
        ]
        self._streams += [
            (
                type_name,
                link.stream_json(name, CAPACITY),
                foxglove.Channel(
                    f"/cbe/{name}",
                    message_encoding="json",
                    schema=foxglove.Schema(
                        name=type_name, encoding="jsonschema", data=JSON_TYPES[type_name]
                    ),
                    context=context,
                ),
            )
            for name, type_name in OWN.items()
        ]
        self._alarms = LogChannel(ALARMS, context=context)
        self._scene = SceneUpdateChannel(SCENE, context=context)
        self._transforms = FrameTransformsChannel(TRANSFORMS, context=context)
        self._frames = {"laser": (Robot().scan_x_m, Robot().scan_height_m)}
        self._said: tuple[Any, ...] = ()
        self._static_s = -STATIC_S
        try:
            self._server = foxglove.start_server(
                name="cbe", host=host, port=port, context=context, message_backlog_size=BACKLOG
            )
        except (RuntimeError, OSError) as error:
            raise ConfigError(
                f"cannot show anything at {host}:{port} ({error}); choose another --port"
            ) from error

    @property
    def port(self) -> int:
        """The port it listens at."""
        return self._server.port

    def run(self, ending: Event) -> None:
        """Pass on what comes until `ending` is set."""
        try:
            while not ending.wait(POLL_S):
                self._pass_on()
        finally:
            self._server.stop()

    def _pass_on(self) -> None:
        wall_ns = time.time_ns() - time.monotonic_ns()
        for type_name, stream, channel in self._streams:
            for sample in stream.drain():
                channel.log(sample.payload, log_time=wall_ns + round(1e9 * sample.received_s))
                self._look_at(type_name, sample)
        if time.monotonic() - self._static_s >= STATIC_S:
            self._static_s = time.monotonic()
            self._place_frames()

    def _look_at(self, type_name: str, sample: Sample) -> None:
        """Draw a status, and learn the sensors' frames by their first messages."""
        try:
            if type_name == "cbe/Status":
                status = msgspec.json.decode(sample.payload)
                if isinstance(status, dict):
                    self._alarm(status)
                    self._draw(status)
            elif type_name == LaserScan.TYPE and sample.count == 1:
                robot = Robot()
                name = LaserScan.from_cdr(sample.payload).frame_id
                self._frames[name] = (robot.scan_x_m, robot.scan_height_m)
            elif type_name in (CompressedImage.TYPE, Image.TYPE) and sample.count == 1:
                robot = Robot()
                message = MESSAGE_TYPES[type_name].cls.from_cdr(sample.payload)
                self._frames[message.frame_id] = (  # type: ignore[attr-defined]
                    robot.camera_x_m,
                    robot.camera_height_m,
                )
        except (MessageError, msgspec.DecodeError) as error:
            logger.debug("%s: %s", type_name, error)

    def _alarm(self, status: dict[str, Any]) -> None:
        """Log each change of state; those that stop the robot as errors."""
        from foxglove.messages import Log, LogLevel

        state, reason = str(status.get("state")), status.get("reason")
        if (state, reason) == self._said:
            return
        self._said = (state, reason)
        level = LogLevel.Error if state in ALARMING else LogLevel.Info
        words = state + (f": {reason}" if reason else "")
        self._alarms.log(Log(level=level, message=words, name="cbe-runtime"))

    def _draw(self, status: dict[str, Any]) -> None:
        """The robot's body, and its waypoint where it has one."""
        from foxglove.messages import (
            Color,
            CylinderPrimitive,
            Pose,
            Quaternion,
            SceneEntity,
            SceneUpdate,
            SpherePrimitive,
            Vector3,
        )

        robot, level = Robot(), Quaternion(w=1.0)
        width, height = 2.0 * robot.body_radius_m, robot.body_top_m - robot.body_bottom_m
        middle = Vector3(z=robot.body_bottom_m + 0.5 * height)
        body = CylinderPrimitive(
            pose=Pose(position=middle, orientation=level),
            size=Vector3(x=width, y=width, z=height),
            bottom_scale=1.0,
            top_scale=1.0,
            color=Color(r=0.9, g=0.9, b=0.95, a=0.6),
        )
        entities = [SceneEntity(frame_id=BASE, id="robot", cylinders=[body])]
        waypoint = status.get("waypoint_m")
        spheres = []
        if isinstance(waypoint, list) and len(waypoint) == 2:
            x, y = map(float, waypoint)
            spheres = [
                SpherePrimitive(
                    pose=Pose(position=Vector3(x=x, y=y, z=0.05), orientation=level),
                    size=Vector3(x=0.1, y=0.1, z=0.1),
                    color=Color(r=1.0, g=0.65, b=0.2, a=1.0),
                )
            ]
        entities.append(SceneEntity(frame_id=BASE, id="waypoint", spheres=spheres))
        self._scene.log(SceneUpdate(entities=entities))

    def _place_frames(self) -> None:
        """Where the sensors are on the robot; a viewer may connect at any time."""
        from foxglove.messages import FrameTransform, FrameTransforms, Quaternion, Vector3

        self._transforms.log(
            FrameTransforms(
                transforms=[
                    FrameTransform(
                        parent_frame_id=BASE,
                        child_frame_id=name,
                        translation=Vector3(x=x_m, z=z_m),
                        rotation=Quaternion(w=1.0),
                    )
                    for name, (x_m, z_m) in self._frames.items()
                    if name != BASE
                ]
            )
        )
