"""One table of what goes over the wire: name, message, rate and freshness limit."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from cbe.codec import Message
from cbe.messages import (
    MESSAGE_TYPES,
    CameraInfo,
    CompressedImage,
    Image,
    LaserScan,
    Odometry,
    Twist,
    TwistStamped,
)

M = TypeVar("M", bound=Message)

FRESH_S = 0.3
"""Input older than this, three steps, stops the robot."""


class KeyStyle(Enum):
    """Who else is on the wire."""

    RMW_ZENOH = "rmw_zenoh"
    """ROS 2 nodes on rmw_zenoh: domain, type and hash are in the key, an attachment follows."""
    BARE = "bare"
    """ROS 2 nodes behind zenoh-bridge-ros2dds: the topic's name alone."""


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """A ROS topic: its name without a leading slash, its message and how often one is due."""

    name: str
    message: type[M]
    rate_hz: float
    fresh_s: float = FRESH_S


CAMERA = Topic("camera/image_raw/compressed", CompressedImage, 10.0)
CAMERA_RAW = Topic("camera/image_raw", Image, 10.0)
SCAN = Topic("scan", LaserScan, 10.0)
CAMERA_INFO = Topic("camera/camera_info", CameraInfo, 1.0, fresh_s=float("inf"))
ODOM = Topic("odom", Odometry, 10.0)
CMD_VEL = Topic("cmd_vel", TwistStamped, 10.0)
CMD_VEL_UNSTAMPED = Topic("cmd_vel", Twist, 10.0)

TOPICS: Mapping[str, Topic[Any]] = MappingProxyType(
    {topic.name: topic for topic in (CAMERA, CAMERA_RAW, SCAN, CAMERA_INFO, ODOM, CMD_VEL)}
)
"""By name; `cmd_vel` carries a TwistStamped unless `CMD_VEL_UNSTAMPED` is asked for."""


def key_expression(topic: Topic[Any], style: KeyStyle, domain: int = 0) -> str:
    """Zenoh key that a topic's messages are published under."""
    if style is KeyStyle.BARE:
        return topic.name
    return f"{_typed_key(topic, domain)}/{MESSAGE_TYPES[topic.message.TYPE].type_hash}"


def subscription(topic: Topic[Any], style: KeyStyle, domain: int = 0) -> str:
    """Zenoh key expression that catches a topic's messages.

    It takes any hash, since ROS 2 Humble's rmw_zenoh writes `TypeHashNotSupported` there.
    """
    if style is KeyStyle.BARE:
        return topic.name
    return f"{_typed_key(topic, domain)}/*"


def _typed_key(topic: Topic[Any], domain: int) -> str:
    package, _, name = topic.message.TYPE.split("/")
    return f"{domain}/{topic.name}/{package}::msg::dds_::{name}_"
