"""Demonstrations: robots driven along A* paths by the controller, all in lock-step (Sec. IV-A)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cbe.controller import Motion, RmpController, twist
from cbe.errors import WorldError
from cbe.geometry import to_frame
from cbe.robot import STEP_S, Robot
from cbe.stop_zone import limit
from cbe_hil_sim.astar import SPACING_M, GoalField
from cbe_hil_sim.clearance import Clearance
from cbe_hil_sim.scanner import scan
from cbe_hil_sim.vehicle import Vehicle
from cbe_hil_sim.world import World
from cbe_hil_sim.worldbatch import WorldBatch

LOOK_AHEAD_M = 0.55
ARRIVED_M = 0.2
ARRIVED_SPEED_MPS = 0.05
STUCK_STEPS = 30
ENDPOINT_CLEARANCE_M = 0.3
PATH_CLEARANCE_M = 0.17
_STARTS_PER_GOAL = 4
_SEARCH_BACK, _SEARCH_AHEAD = 4, 16  # path points around the last closest one


@dataclass(frozen=True, slots=True)
class Demonstration:
    """One drive at 10 Hz: T poses from the start at rest to the goal.

    `poses` (T, 3) world, `speed_mps` and `steer_rad` (T,) as driven, `world` and `route` the
    indices into what was given to `demonstrate`, `world_name` the world's own name.
    """

    world_name: str
    world: int
    route: int
    poses: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    steer_rad: NDArray[np.float64]
    min_clearance_m: float  # from the body's surface

    @property
    def length_m(self) -> float:
        """Distance driven."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())


class PathFollower:
    """Waypoints for B robots along their paths: the point a little ahead of the closest one."""

    def __init__(
        self, paths: Sequence[NDArray[np.float64]], look_ahead_m: float = LOOK_AHEAD_M
    ) -> None:
        """`paths` are B polylines (N, 2) with a point each 0.05 m."""
        self._last = np.array([len(path) - 1 for path in paths])
        self._paths = np.stack(
            [np.pad(p, ((0, self._last.max() + 1 - len(p)), (0, 0)), mode="edge") for p in paths]
        )  # (B, N, 2)
        self._ahead = round(look_ahead_m / SPACING_M)
        self.closest = np.zeros(len(paths), np.int64)

    def waypoint(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Waypoints (B, 2) in base_link at world `poses` (B, 3); the path's end near its end.

        The closest point is sought near the last one, since paths may cross themselves.
        """
        rows = np.arange(len(poses))
        window = self.closest[:, None] + np.arange(-_SEARCH_BACK, _SEARCH_AHEAD + 1)
        window = np.clip(window, 0, self._last[:, None])
        offset = self._paths[rows[:, None], window] - poses[:, None, :2]
        self.closest = window[rows, (offset**2).sum(axis=-1).argmin(axis=1)]
        target = np.minimum(self.closest + self._ahead, self._last)
        return to_frame(poses, self._paths[rows, target])

    def end_distance_m(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Straight distance (B,) to the paths' ends; inf while the end is not yet in reach."""
        end = self._paths[np.arange(len(poses)), self._last]
        distance = np.hypot(*(end - poses[:, :2]).T)
        return np.where(self._last - self.closest <= self._ahead, distance, np.inf)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the robots that are not chosen (B,)."""
        self._paths, self._last = self._paths[chosen], self._last[chosen]
        self.closest = self.closest[chosen]


def start_pose(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose (3,) at a path's first point, heading along it."""
    ahead = path[min(6, len(path) - 1)] - path[0]
    return np.array([path[0, 0], path[0, 1], np.arctan2(ahead[1], ahead[0])])


def sample_routes(
    world: World,
    count: int,
    rng: np.random.Generator,
    min_length_m: float,
    max_length_m: float,
) -> list[NDArray[np.float64]]:
    """`count` paths (N, 2) of a length between the limits, between random places of a world.

    Longer ways are cut to a random part. WorldError if the world is too small or too cluttered.
    """
    free = world.clearance_m >= ENDPOINT_CLEARANCE_M
    places = np.argwhere(free)[:, ::-1]
    points = (places + 0.5) * world.resolution_m + np.array(world.origin_m)  # (N, 2)
    routes: list[NDArray[np.float64]] = []
    if len(points) == 0:
        raise WorldError(f"world {world.name!r} has no place {ENDPOINT_CLEARANCE_M} m clear")
    for _ in range(10 + 3 * count):
        field = GoalField(world, rng.choice(points))
        cost = field.cost_at(points)
        starts = points[(cost >= min_length_m) & np.isfinite(cost)]
        if len(starts) == 0:
            continue
        for start in rng.choice(starts, _STARTS_PER_GOAL):
            path = _cut(field.path(start), rng, min_length_m, max_length_m)
            if path is not None and world.clearance_at(path).min() >= PATH_CLEARANCE_M:
                routes.append(path)
                if len(routes) == count:
                    return routes
    raise WorldError(
        f"world {world.name!r} gave {len(routes)} of {count} routes of {min_length_m} to "
        f"{max_length_m} m; ask for shorter routes or use a larger world"
    )


def demonstrate(
    batch: WorldBatch,
    worlds: Sequence[World],
    world_index: NDArray[np.integer],
    paths: Sequence[NDArray[np.float64]],
    robot: Robot,
    *,
    controller: RmpController | None = None,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> list[Demonstration]:
    """Drive all paths, path b in `worlds[world_index[b]]`; drives that fail are left out.

    A drive fails by touching something, by standing still for 3 s or by not arriving in three
    times the time its path would take at full speed. `batch` is `WorldBatch.pack(worlds)`,
    `noise` as in `Vehicle`.
    """
    controller = controller or RmpController(robot)
    clearance = Clearance(worlds)
    vehicle = Vehicle(np.stack([start_pose(p) for p in paths]), robot, noise=noise, rng=rng)
    follower = PathFollower(paths)
    active = np.arange(len(paths))
    where = np.asarray(world_index, dtype=np.int64)
    fastest = np.array([len(p) for p in paths]) * SPACING_M / (robot.max_speed_mps * STEP_S)
    deadline = 100 + np.ceil(3.0 * fastest).astype(np.int64)
    steps = int(deadline.max()) + 1
    log = np.zeros((len(paths), steps, 6))  # x, y, yaw, speed, steering, clearance
    drives: list[Demonstration] = []
    still = np.zeros(len(paths), np.int64)
    commanded = vehicle.motion
    for step in range(steps):
        body = clearance.at(where, vehicle.poses[:, :2]) - robot.body_radius_m
        log[active, step, :3] = vehicle.poses
        log[active, step, 3], log[active, step, 4] = vehicle.speed_mps, vehicle.steer_rad
        log[active, step, 5] = body
        waypoint = follower.waypoint(vehicle.poses)
        resting = vehicle.speed_mps < ARRIVED_SPEED_MPS
        arrived = resting & (follower.end_distance_m(vehicle.poses) < ARRIVED_M)
        for b in active[arrived]:
            part = log[b, : step + 1]
            drives.append(
                Demonstration(
                    world_name=worlds[world_index[b]].name,
                    world=int(world_index[b]),
                    route=int(b),
                    poses=part[:, :3].copy(),
                    speed_mps=part[:, 3].copy(),
                    steer_rad=part[:, 4].copy(),
                    min_clearance_m=float(part[:, 5].min()),
                )
            )
        still = np.where(resting, still + 1, 0)
        going = ~arrived & (body >= 0.0) & (step < deadline[active]) & (still < STUCK_STEPS)
        if not going.all():
            active, where, waypoint = active[going], where[going], waypoint[going]
            still = still[going]
            follower.keep(going)
            vehicle.keep(going)
            commanded = Motion(commanded.speed_mps[going], commanded.steer_rad[going])
        if len(active) == 0:
            break
        scans = scan(batch, where, vehicle.poses, robot)
        commanded = limit(controller.step(commanded, waypoint, scans), scans, robot)
        vehicle.step(*twist(commanded, robot))
    return sorted(drives, key=lambda drive: drive.route)


def _cut(
    path: NDArray[np.float64], rng: np.random.Generator, min_length_m: float, max_length_m: float
) -> NDArray[np.float64] | None:
    """Random part of a path between the limits, or None if it is too short."""
    points = len(path)
    longest = int(max_length_m / SPACING_M)
    shortest = int(np.ceil(min_length_m / SPACING_M)) + 1
    if points < shortest:
        return None
    if points <= longest:
        return path
    length = int(rng.integers(shortest, max(longest, shortest) + 1))
    first = int(rng.integers(0, points - length + 1))
    return path[first : first + length]
