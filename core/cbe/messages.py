"""The ROS 2 messages in use as frozen dataclasses, to and from CDR."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from cbe.camera import CameraModel
from cbe.codec import Message, new, schema, type_hash
from cbe.errors import MessageError

NANOSECONDS = 1_000_000_000
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class CompressedImage(Message):
    """A JPEG or PNG file in `data` (n,) uint8; `stamp_ns` is the time of capture."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/CompressedImage"

    stamp_ns: int
    frame_id: str
    format: str
    data: Bytes

    def _to_ros(self) -> object:
        return new(self.TYPE, _header(self.stamp_ns, self.frame_id), self.format, self.data)

    @classmethod
    def _from_ros(cls, ros: Any) -> Self:
        return cls(_stamp_ns(ros.header), ros.header.frame_id, ros.format, ros.data)


@dataclass(frozen=True, slots=True, eq=False)
class Image(Message):
    """Raw pixels: `data` (height * step,) uint8, `step` bytes a row, `encoding` as "rgb8"."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/Image"

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    step: int
    data: Bytes

    def _to_ros(self) -> object:
        header = _header(self.stamp_ns, self.frame_id)
        return new(
            self.TYPE, header, self.height, self.width, self.encoding, 0, self.step, self.data
        )

    @classmethod
    def _from_ros(cls, ros: Any) -> Self:
        return cls(
            stamp_ns=_stamp_ns(ros.header),
            frame_id=ros.header.frame_id,
            height=ros.height,
            width=ros.width,
            encoding=ros.encoding,
            step=ros.step,
            data=ros.data,
        )


@dataclass(frozen=True, slots=True)
class CameraInfo(Message):
    """A camera's calibration: K `matrix` (9) row by row, in pixels whose centres are whole."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/CameraInfo"

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    distortion_model: str
    distortion: tuple[float, ...]
    matrix: tuple[float, ...]

    @classmethod
    def of(cls, camera: CameraModel, stamp_ns: int, frame_id: str = "camera_optical") -> Self:
        """The calibration that a camera of this model publishes."""
        if camera.model == "fisheye":
            name, coefficients = "equidistant", 4
        else:
            rational = len(camera.distortion) > 5
            name, coefficients = ("rational_polynomial", 8) if rational else ("plumb_bob", 5)
        padded = (*camera.distortion, *(0.0,) * coefficients)[:coefficients]
        size = (camera.height, camera.width)
        return cls(stamp_ns, frame_id, *size, name, padded, camera.matrix)

    def camera(self) -> CameraModel:
        """The camera's model; raises CameraError where these numbers are no usable camera's."""
        return CameraModel.from_calibration(
            self.width, self.height, self.matrix, self.distortion_model, self.distortion
        )

    def _to_ros(self) -> object:
        k = np.array(self.matrix, np.float64)
        projection = np.zeros((3, 4))
        projection[:, :3] = k.reshape(3, 3)  # (9,) to (3, 3)
        return new(
            self.TYPE,
            _header(self.stamp_ns, self.frame_id),
            self.height,
            self.width,
            self.distortion_model,
            np.array(self.distortion, np.float64),
            k,
            np.array(IDENTITY),
            projection.reshape(12),
            0,
            0,
            new("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False),
        )

    @classmethod
    def _from_ros(cls, ros: Any) -> Self:
        return cls(
            stamp_ns=_stamp_ns(ros.header),
            frame_id=ros.header.frame_id,
            height=ros.height,
            width=ros.width,
            distortion_model=ros.distortion_model,
            distortion=tuple(ros.d.tolist()),
            matrix=tuple(ros.k.tolist()),
        )


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan(Message):
    """One sweep of a planar lidar, counter-clockwise for a positive increment.

    `ranges_m` (n,) float32: inf where nothing returned, NaN where invalid.
    `cbe.rays.resample` brings it onto the robot's own rays.
    """

    TYPE: ClassVar[str] = "sensor_msgs/msg/LaserScan"

    stamp_ns: int
    frame_id: str
    angle_min_rad: float
    angle_max_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    ranges_m: Floats
    time_increment_s: float = 0.0
    scan_time_s: float = 0.0
    intensities: Floats = field(default_factory=lambda: np.empty(0, np.float32))

    def _to_ros(self) -> object:
        return new(
            self.TYPE,
            _header(self.stamp_ns, self.frame_id),
            self.angle_min_rad,
            self.angle_max_rad,
            self.angle_increment_rad,
            self.time_increment_s,
            self.scan_time_s,
            self.range_min_m,
            self.range_max_m,
            np.ascontiguousarray(self.ranges_m, np.float32),
            np.ascontiguousarray(self.intensities, np.float32),
        )

    @classmethod
    def _from_ros(cls, ros: Any) -> Self:
        return cls(
            stamp_ns=_stamp_ns(ros.header),
            frame_id=ros.header.frame_id,
            angle_min_rad=ros.angle_min,
            angle_max_rad=ros.angle_max,
            angle_increment_rad=ros.angle_increment,
            range_min_m=ros.range_min,
            range_max_m=ros.range_max,
            ranges_m=ros.ranges,
            time_increment_s=ros.time_increment,
            scan_time_s=ros.scan_time,
            intensities=ros.intensities,
        )


@dataclass(frozen=True, slots=True)
class Twist(Message):
    """A velocity in base_link; one that is not finite is refused, as no robot may obey it."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Twist"

    linear_mps: Vector = (0.0, 0.0, 0.0)
    angular_rad_s: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse NaN and infinity."""
        if not all(map(math.isfinite, (*self.linear_mps, *self.angular_rad_s))):
            raise MessageError(f"a twist must be finite; found {self}")

    @classmethod
    def planar(cls, speed_mps: float, yaw_rate_rad_s: float) -> Self:
        """Forward speed and counter-clockwise yaw rate."""
        return cls((float(speed_mps), 0.0, 0.0), (0.0, 0.0, float(yaw_rate_rad_s)))

    @property
    def speed_mps(self) -> float:
        """Forward speed."""
        return self.linear_mps[0]

    @property
    def yaw_rate_rad_s(self) -> float:
        """Yaw rate, counter-clockwise."""
        return self.angular_rad_s[2]

    def _to_ros(self) -> object:
        linear = new("geometry_msgs/msg/Vector3", *self.linear_mps)
        return new(self.TYPE, linear, new("geometry_msgs/msg/Vector3", *self.angular_rad_s))

    @classmethod
    def _from_ros(cls, ros: Any) -> Self:
        return cls(_xyz(ros.linear), _xyz(ros.angular))


@dataclass(frozen=True, slots=True)
class TwistStamped(Message):
    """A velocity command; in lock-step `stamp_ns` is that of the frame it answers."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/TwistStamped"

    stamp_ns: int
    frame_id: str
    twist: Twist

    def _to_ros(self) -> object:
        return new(self.TYPE, _header(self.stamp_ns, self.frame_id), self.twist._to_ros())

    @classmethod
    def _from_ros(cls, ros: Any) -> Self:
        return cls(_stamp_ns(ros.header), ros.header.frame_id, Twist._from_ros(ros.twist))


@dataclass(frozen=True, slots=True)
class Odometry(Message):
    """Where the robot believes it is (in odom) and its velocity (in base_link).

    The policy never uses it; covariances are written as zero and not read.
    """

    TYPE: ClassVar[str] = "nav_msgs/msg/Odometry"

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    position_m: Vector
    orientation_xyzw: Quaternion
    twist: Twist

    @classmethod
    def planar(cls, stamp_ns: int, pose: Vector, speed_mps: float, yaw_rate_rad_s: float) -> Self:
        """From a planar pose (x m, y m, yaw rad)."""
        x, y, yaw = map(float, pose)
        turn = (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
        twist = Twist.planar(speed_mps, yaw_rate_rad_s)
        return cls(stamp_ns, "odom", "base_link", (x, y, 0.0), turn, twist)

    @property
    def pose(self) -> Vector:
        """Planar pose: x (m), y (m), yaw (rad)."""
        x, y, z, w = self.orientation_xyzw
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return self.position_m[0], self.position_m[1], yaw

    def _to_ros(self) -> object:
        pose = new(
            "geometry_msgs/msg/Pose",
            new("geometry_msgs/msg/Point", *self.position_m),
            new("geometry_msgs/msg/Quaternion", *self.orientation_xyzw),
        )
        return new(
            self.TYPE,
            _header(self.stamp_ns, self.frame_id),
            self.child_frame_id,
            new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
            new("geometry_msgs/msg/TwistWithCovariance", self.twist._to_ros(), np.zeros(36)),
        )

    @classmethod
    def _from_ros(cls, ros: Any) -> Self:
        position, turn = ros.pose.pose.position, ros.pose.pose.orientation
        return cls(
            stamp_ns=_stamp_ns(ros.header),
            frame_id=ros.header.frame_id,
            child_frame_id=ros.child_frame_id,
            position_m=_xyz(position),
            orientation_xyzw=(turn.x, turn.y, turn.z, turn.w),
            twist=Twist._from_ros(ros.twist.twist),
        )


@dataclass(frozen=True)
class MessageType:
    """A message's ROS name ("sensor_msgs/msg/LaserScan"), its class, schema and hash."""

    name: str
    cls: type[Message]

    @cached_property
    def definition(self) -> str:
        """Schema text in MCAP's `ros2msg` encoding, with all the types it refers to."""
        return schema(self.name)

    @cached_property
    def type_hash(self) -> str:
        """`RIHS01_...`."""
        return type_hash(self.name)


MESSAGE_TYPES = {
    cls.TYPE: MessageType(cls.TYPE, cls)
    for cls in (CompressedImage, Image, CameraInfo, LaserScan, Odometry, TwistStamped, Twist)
}


def _header(stamp_ns: int, frame_id: str) -> object:
    time = new("builtin_interfaces/msg/Time", *divmod(stamp_ns, NANOSECONDS))
    return new("std_msgs/msg/Header", time, frame_id)


def _stamp_ns(header: Any) -> int:
    if header.stamp.nanosec >= NANOSECONDS:
        raise MessageError(f"a stamp of {header.stamp.nanosec} ns past the second is malformed")
    return int(header.stamp.sec * NANOSECONDS + header.stamp.nanosec)


def _xyz(vector: Any) -> Vector:
    return vector.x, vector.y, vector.z
