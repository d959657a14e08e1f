"""The car under pybullet's physics: four wheels on friction, Ackermann steering, a body to hit."""

import math
import tempfile
from pathlib import Path

import numpy as np
import pybullet
from numpy.typing import NDArray

from cbe.geometry import wrap_angle
from cbe.robot import STEP_S, Robot

SUBSTEPS = 24
TIME_STEP_S = STEP_S / SUBSTEPS

# Collision groups. A pair meets where either's group is in the other's mask; rays are in group 1.
SOLID, GROUND, BODY, WHEEL = 1, 2, 4, 8
SOLID_MASK = SOLID | BODY

_TRACK_M = 0.1
_WHEEL_RADIUS_M = 0.03
_MASS_KG = 2.0
_WHEEL_STIFFNESS_N_PER_M = 5e3
_WHEEL_DAMPING_NS_PER_M = 100.0
_WEIGHT_N = 9.81 * (_MASS_KG + 4 * 0.05 + 2 * 0.02)  # with wheels and knuckles
_DRIVE_TORQUE_NM = 0.2  # a wheel's; spins rather than pushes furniture
_STEER_TORQUE_NM = 1.0
_GANTRY = ("x", "y", "z", "yaw")
_REAR, _FRONT = ("rear_left", "rear_right"), ("front_left", "front_right")
_KNUCKLES = ("knuckle_left", "knuckle_right")


class Car:
    """One Ackermann car, moved by the friction of its wheels alone.

    Massless slides and a turntable hold it upright, since the mast would tip it at table edges;
    they also tell its pose.
    """

    def __init__(self, client: int, robot: Robot) -> None:
        """Load the car and its ground into a pybullet client."""
        self._client, self._robot = client, robot
        ground = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        plane = pybullet.createMultiBody(baseCollisionShapeIndex=ground, physicsClientId=client)
        self._filter(plane, -1, GROUND, WHEEL)
        pybullet.changeDynamics(plane, -1, lateralFriction=1.0, physicsClientId=client)
        with tempfile.TemporaryDirectory(prefix="cbe-car-") as folder:
            path = Path(folder) / "car.urdf"
            path.write_text(_urdf(robot))
            self.body: int = pybullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
        count = pybullet.getNumJoints(self.body, physicsClientId=client)
        names = [
            pybullet.getJointInfo(self.body, joint, physicsClientId=client)[1].decode()
            for joint in range(count)
        ]
        self._joint = {name: joint for joint, name in enumerate(names)}
        for name, joint in self._joint.items():
            wheel = name in _REAR + _FRONT
            self._filter(self.body, joint, WHEEL if wheel else BODY, GROUND if wheel else SOLID)
            pybullet.changeDynamics(
                self.body, joint, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0,
                lateralFriction=1.0 if wheel else 0.2, physicsClientId=client,
            )  # fmt: skip
            if wheel:  # rubber: four rigid wheels would not share the load
                pybullet.changeDynamics(
                    self.body, joint, contactStiffness=_WHEEL_STIFFNESS_N_PER_M,
                    contactDamping=_WHEEL_DAMPING_NS_PER_M, physicsClientId=client,
                )  # fmt: skip
        self.body_link: int = self._joint["yaw"]
        self.reset(np.zeros(3))

    @property
    def pose(self) -> NDArray[np.float64]:
        """World pose of base_link (3,): x m, y m, yaw rad."""
        x, y, _, yaw = (state[0] for state in self._states())
        return np.array([x, y, wrap_angle(np.array(yaw))])

    @property
    def twist(self) -> tuple[float, float]:
        """Forward speed in m/s and yaw rate in rad/s, as driven."""
        (_, vx), (_, vy), _, (yaw, rate) = (state[:2] for state in self._states())
        return vx * math.cos(yaw) + vy * math.sin(yaw), rate

    @property
    def steer_rad(self) -> float:
        """Present steering angle of the middle of the front axle."""
        return self._steer_rad

    def reset(self, pose: NDArray[np.float64]) -> None:
        """Put the car at rest at a world pose (3,), wheels straight."""
        self._speed_mps = self._steer_rad = 0.0
        for joint in self._joint.values():
            pybullet.resetJointState(self.body, joint, 0.0, 0.0, physicsClientId=self._client)
            pybullet.setJointMotorControl2(
                self.body, joint, pybullet.VELOCITY_CONTROL, force=0.0,
                physicsClientId=self._client,
            )  # fmt: skip
        sag_m = -_WEIGHT_N / (4.0 * _WHEEL_STIFFNESS_N_PER_M)  # on its wheels already
        for name, value in zip(_GANTRY, (pose[0], pose[1], sag_m, pose[2]), strict=True):
            pybullet.resetJointState(
                self.body, self._joint[name], float(value), 0.0, physicsClientId=self._client
            )

    def drive(self, speed_mps: float, steer_rad: float) -> None:
        """Move the set speed and steering one physics step towards the commanded ones."""
        robot = self._robot
        self._speed_mps += _clip(
            speed_mps - self._speed_mps,
            -robot.max_braking_mps2 * TIME_STEP_S,
            robot.max_acceleration_mps2 * TIME_STEP_S,
        )
        turn = robot.max_steer_rate_rad_s * TIME_STEP_S
        self._steer_rad += _clip(steer_rad - self._steer_rad, -turn, turn)
        curvature = math.tan(self._steer_rad) / robot.wheelbase_m
        sides = (0.5 * _TRACK_M, -0.5 * _TRACK_M)  # left, right
        # Each wheel rolls about the one centre of the turn.
        rolling = [self._speed_mps * (1.0 - curvature * y) / _WHEEL_RADIUS_M for y in sides]
        angles = [math.atan(robot.wheelbase_m * curvature / (1.0 - curvature * y)) for y in sides]
        self._motors(_REAR, pybullet.VELOCITY_CONTROL, _DRIVE_TORQUE_NM, targetVelocities=rolling)
        self._motors(_KNUCKLES, pybullet.POSITION_CONTROL, _STEER_TORQUE_NM, targetPositions=angles)

    def _motors(
        self, names: tuple[str, ...], mode: int, torque_nm: float, **targets: list[float]
    ) -> None:
        joints = [self._joint[name] for name in names]
        pybullet.setJointMotorControlArray(
            self.body, joints, mode, forces=[torque_nm] * len(joints),
            physicsClientId=self._client, **targets,
        )  # fmt: skip

    def _states(self) -> list[tuple[float, float]]:
        joints = [self._joint[name] for name in _GANTRY]
        states = pybullet.getJointStates(self.body, joints, physicsClientId=self._client)
        return [(state[0], state[1]) for state in states]

    def _filter(self, body: int, link: int, group: int, mask: int) -> None:
        pybullet.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=self._client)


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _urdf(robot: Robot) -> str:
    """Describe the car for pybullet: gantry, body, knuckles, wheels; origin on the floor."""
    half = 0.5 * _TRACK_M
    height = robot.body_top_m - robot.body_bottom_m
    middle = 0.5 * (robot.body_top_m + robot.body_bottom_m)
    body = (
        f'<collision><origin xyz="0 0 {middle}"/><geometry>'
        f'<cylinder radius="{robot.body_radius_m}" length="{height}"/></geometry></collision>'
    )
    wheel = f'<collision><geometry><sphere radius="{_WHEEL_RADIUS_M}"/></geometry></collision>'
    mass = f"{0.5 * robot.wheelbase_m} 0 {_WHEEL_RADIUS_M}"
    parts = [
        _link("world", 0.0),
        *(_link(name, 1e-3) for name in ("slide_x", "slide_y", "slide_z")),
        _link("base_link", _MASS_KG, mass, body, inertia=0.01),
        _joint("x", "prismatic", "world", "slide_x", axis="1 0 0"),
        _joint("y", "prismatic", "slide_x", "slide_y", axis="0 1 0"),
        _joint("z", "prismatic", "slide_y", "slide_z", axis="0 0 1"),
        _joint("yaw", "continuous", "slide_z", "base_link", axis="0 0 1"),
    ]
    for side, y in (("left", half), ("right", -half)):
        parts += [
            _link(f"rear_wheel_{side}", 0.05, collision=wheel, inertia=2e-5),
            _link(f"front_knuckle_{side}", 0.02, inertia=1e-5),
            _link(f"front_wheel_{side}", 0.05, collision=wheel, inertia=2e-5),
            _joint(
                f"rear_{side}", "continuous", "base_link", f"rear_wheel_{side}",
                at=f"0 {y} {_WHEEL_RADIUS_M}", axis="0 1 0",
            ),
            _joint(
                f"knuckle_{side}", "continuous", "base_link", f"front_knuckle_{side}",
                at=f"{robot.wheelbase_m} {y} {_WHEEL_RADIUS_M}", axis="0 0 1",
            ),
            _joint(
                f"front_{side}", "continuous", f"front_knuckle_{side}", f"front_wheel_{side}",
                axis="0 1 0",
            ),
        ]  # fmt: skip
    return f'<robot name="car">{"".join(parts)}</robot>'


def _link(
    name: str, mass_kg: float, at: str = "0 0 0", collision: str = "", *, inertia: float = 1e-6
) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}"/><mass value="{mass_kg}"/>'
        f'<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/>'
        f"</inertial>{collision}</link>"
    )


def _joint(name: str, kind: str, parent: str, child: str, *, axis: str, at: str = "0 0 0") -> str:
    # Limits would be springs to pybullet: a lower one above the upper means none.
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}"/><axis xyz="{axis}"/>'
        '<limit lower="1" upper="-1" effort="1000" velocity="1000"/></joint>'
    )
