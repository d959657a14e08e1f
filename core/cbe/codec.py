"""CDR codec of the ROS 2 message definitions in use; no other types are ever loaded."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

from cbe.errors import MessageError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/msg/Pose": (
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation"
    ),
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/msg/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist"
    ),
    "sensor_msgs/msg/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
    ),
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n"
        "uint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/msg/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "sensor_msgs/msg/LaserScan": (
        "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\n"
        "float32 angle_increment\nfloat32 time_increment\nfloat32 scan_time\n"
        "float32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities"
    ),
}


class Message(ABC):
    """Base of all messages. Arrays decoded from a buffer are read-only views of it."""

    __slots__ = ()
    TYPE: ClassVar[str]

    def to_cdr(self) -> bytes:
        """Little-endian CDR with its header; raises MessageError where a value does not fit."""
        from rosbags.serde import SerdeError

        try:
            ros = self._to_ros()
            return bytes(_typestore().serialize_cdr(ros, self.TYPE, little_endian=True))
        except (SerdeError, struct.error, ValueError, AttributeError, TypeError) as error:
            raise MessageError(f"cannot write this {self.TYPE}: {error}") from error

    @classmethod
    def from_cdr(cls, data: bytes | memoryview) -> Self:
        """Decode; raises MessageError for truncated or malformed bytes."""
        from rosbags.serde import SerdeError

        try:
            ros = _typestore().deserialize_cdr(memoryview(data), cls.TYPE)
        except (SerdeError, struct.error, ValueError, IndexError, OverflowError) as error:
            raise MessageError(
                f"{len(data)} bytes are no {cls.TYPE}: {error}; check the sender's message type"
            ) from error
        return cls._from_ros(ros)

    @abstractmethod
    def _to_ros(self) -> object:
        """The codec's object of this message."""

    @classmethod
    @abstractmethod
    def _from_ros(cls, ros: Any) -> Self:
        """Inverse of `_to_ros`."""


def prepare(*types: type[Message]) -> None:
    """Compile these types' codecs now (10 ms each), so that no first message waits for it."""
    for each in types:
        _typestore().get_msgdef(each.TYPE)


def new(name: str, *values: object) -> object:
    """The codec's object of a type, from all its fields in order."""
    return cast(Any, _typestore().types[name])(*values)


def schema(name: str) -> str:
    """A type's definition followed by those it refers to, as MCAP's `ros2msg` schemas have it."""
    return _typestore().generate_msgdef(name, ros_version=2)[0]


def type_hash(name: str) -> str:
    """A type's `RIHS01_...` hash (REP-2016)."""
    return _typestore().hash_rihs01(name)


@cache
def _typestore() -> Typestore:
    """The codec of these definitions alone: loading every type of a ROS release costs 96 ms."""
    from rosbags.typesys.msg import get_types_from_msg
    from rosbags.typesys.store import Typestore

    store = Typestore()
    types = [get_types_from_msg(text, name) for name, text in DEFINITIONS.items()]
    store.register({name: fields for each in types for name, fields in each.items()})
    return store
