"""Lock-step rollouts: behaviors are shown, then repeated from jittered starts (Sec. IV-A)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cbe import geometry
from cbe.camera import MODEL_CAMERA
from cbe.controller import Motion, RmpController, twist
from cbe.robot import Robot
from cbe.stop_zone import limit
from cbe_hil_sim.render import render
from cbe_hil_sim.scanner import scan
from cbe_hil_sim.vehicle import Vehicle
from cbe_training import appearance, track
from cbe_training.appearance import Appearance
from cbe_training.config import TrainConfig
from cbe_training.drives import Drives
from cbe_training.networks import BehaviorNetworks
from cbe_training.policy import Policy, Seen, memorise

USUAL_GAP, OTHER_GAPS = 2, (1, 3)  # steps between frames: the runtime's, and slower and faster
FRAMES_PAST_GOAL = 3
FRAMES_OFF_ROUTE = 4
FRAMES_KIDNAPPED = 14  # and so long where it was carried away, to learn what lost looks like
NEVER = 1 << 30
ALIASED = 0.3  # share of behaviors rendered without antialiasing, as other renderers do
REACHED = 0.985  # share of the path
BIN_AWAY_M = 0.5  # from a repetition's start and goal
NOISE_RAD = (0.0, 0.0, 0.15, 0.4)  # of the expert's waypoint, so that it has errors to correct


@dataclass(frozen=True, slots=True)
class Behaviors:
    """D shown behaviors: a stretch of a drive each, of one length and one frame gap."""

    paths: track.Paths  # D
    world: NDArray[np.int64]  # (D,)
    cameras: Appearance  # D
    images: NDArray[np.uint8]  # (D, T, 64, 64, 3)
    frame_poses: NDArray[np.float64]  # (D, T, 3)
    gap: int  # steps between frames
    supersample: int


@dataclass(frozen=True, slots=True)
class Rollouts:
    """B repetitions, padded to the longest; `frames[b]` entries of row b are real."""

    images: NDArray[np.uint8]  # (B, T, 64, 64, 3)
    poses: NDArray[np.float64]  # (B, T, 3)
    waypoint_m: NDArray[np.float32]  # (B, T, 2) labels
    progress: NDArray[np.float32]  # (B, T)
    on_route: NDArray[np.bool_]  # (B, T)
    frames: NDArray[np.int64]  # (B,)
    shown: NDArray[np.int64]  # (B,) behavior whose memory it got
    driven: NDArray[np.int64]  # (B,) behavior it was labelled by
    goals: NDArray[np.float64]  # (B, 3) last pose of the shown behavior
    starts: NDArray[np.float64]  # (B, 3) first pose of the shown behavior
    carried: NDArray[np.int64]  # (B,) frame before which it was put elsewhere, or NEVER
    arrived: NDArray[np.bool_]  # (B,) declared so itself
    collided: NDArray[np.bool_]
    success: NDArray[np.bool_]  # arrived within 0.5 m and 30 deg, without collision
    seen: Seen | None = None  # B sequences, as the driving networks saw them
    shown_seen: Seen | None = None  # D sequences


def show(drives: Drives, count: int, frames: int, gap: int, rng: np.random.Generator) -> Behaviors:
    """Cut `count` behaviors of `frames` frames out of random drives and look along them."""
    steps = (frames - 1) * gap + 1
    long_enough = np.array([i for i, poses in enumerate(drives.poses) if len(poses) > steps])
    chosen = rng.choice(long_enough, count, replace=False)
    pieces = []
    for i in chosen:
        first = rng.integers(0, len(drives.poses[i]) - steps + 1)
        pieces.append(drives.poses[i][first : first + steps])
    paths = track.Paths.build(pieces)
    cameras = appearance.sample(rng, count, Robot().camera_height_m)
    frame_poses = paths.poses[:, ::gap]
    world = drives.world[chosen]
    every = np.repeat(np.arange(count), frames)
    supersample = 1 if rng.random() < ALIASED else 2
    images = photograph(
        drives, world[every], frame_poses.reshape(-1, 3), cameras.take(every), supersample, rng
    )
    images = images.reshape(count, frames, *images.shape[1:])
    return Behaviors(paths, world, cameras, images, frame_poses, gap, supersample)


def roll_out(
    networks: BehaviorNetworks | None,
    drives: Drives,
    behaviors: Behaviors,
    config: TrainConfig,
    rng: np.random.Generator,
    *,
    expert_share: float,
    training: bool = True,
    noise: float = 0.0,
) -> Rollouts:
    """Repeat each behavior `config.repeats` times, the expert driving `expert_share` of the ticks.

    Without networks the expert drives alone. In training some robots get another's memory or
    start midway; outside it the robot stops itself where its progress says it has arrived.
    """
    robot, controller = Robot(), RmpController()
    cast = _Cast.draw(behaviors, config, rng, training=training)
    count, gap = len(cast.driven), behaviors.gap
    paths, world = behaviors.paths.take(cast.driven), behaviors.world[cast.driven]
    last = cast.first.copy()
    if training:
        world = _among_bins(drives, world, paths, last, config, rng)
    starts = _jitter(drives, world, paths.poses[np.arange(count), last], config, rng)
    vehicle = Vehicle(starts, robot, noise=noise, rng=rng)
    vehicle.speed_mps = np.where(rng.random(count) < 0.5, rng.uniform(0.0, 0.5, count), 0.0)
    cameras = appearance.vary(rng, behaviors.cameras.take(cast.driven))
    longest = int(behaviors.images.shape[1] * (1.3 if training else 2.0)) + 8
    out = _empty(count, longest, behaviors, cast)
    policy = None
    if networks is not None:
        memory, shown_seen = memorise(networks, behaviors.images)
        policy = Policy(networks, memory.take(cast.shown))
        seen = Seen(*(new.new_zeros(count, longest, new.shape[-1]) for new in shown_seen))
        out = replace(out, seen=seen, shown_seen=shown_seen)

    active = np.ones(count, np.bool_)
    past_goal, off_route, nearly = np.zeros((3, count), np.int64)
    angle = np.zeros(count)
    for tick in range(longest):
        rows = np.flatnonzero(active)
        if not len(rows):
            break
        for row in np.flatnonzero(active & (cast.carried == tick)):
            vehicle.poses[row] = _elsewhere(drives, behaviors.world[cast.driven[row]], rng)
        poses = vehicle.poses[rows]
        images = photograph(
            drives, world[rows], poses, cameras.take(rows), behaviors.supersample, rng
        )
        labels = track.label(paths.take(rows), poses, last[rows], config.lookahead_m)
        last[rows] = labels.closest
        on_route = (labels.distance_m < config.off_route_m) & ~cast.wrong[rows]
        out.images[rows, tick], out.poses[rows, tick] = images, poses
        out.waypoint_m[rows, tick], out.progress[rows, tick] = labels.waypoint_m, labels.progress
        out.on_route[rows, tick] = on_route
        out.frames[rows] += 1

        angle = 0.8 * angle + 0.6 * cast.wobble_rad * rng.standard_normal(count)
        waypoint = _turn(labels.waypoint_m, angle[rows])
        if policy is not None:
            own, progress, _ = policy.tick(rows, images)
            for kept, new in zip(out.seen or (), policy.seen, strict=True):
                kept[rows, tick] = new[:, 0]
            mine = (rng.random(len(rows)) >= expert_share) & ~cast.expert_only[rows]
            waypoint = np.where(mine[:, None], own, waypoint)
            nearly[rows] = np.where(progress >= 0.95, nearly[rows] + 1, 0)
            if not training:
                out.arrived[rows] = nearly[rows] >= 2
        hit = _drive(vehicle, controller, drives, rows, world, waypoint, gap)
        out.collided[rows] = hit
        past_goal[rows] += labels.progress >= REACHED
        off_route[rows] += labels.distance_m >= config.off_route_m
        patience = np.where(cast.carried[rows] <= tick, FRAMES_KIDNAPPED, FRAMES_OFF_ROUTE)
        active[rows] = ~hit & (off_route[rows] < patience) & ~out.arrived[rows]
        if training:
            active[rows] &= past_goal[rows] < FRAMES_PAST_GOAL
    error = geometry.relative(paths.goals, vehicle.poses)
    near = np.hypot(error[:, 0], error[:, 1]) < 0.5
    aligned = np.abs(error[:, 2]) < np.radians(30.0)
    out.success[:] = out.arrived & near & aligned & ~out.collided
    return out


@dataclass(frozen=True, slots=True)
class _Cast:
    """Who of B robots is shown what, and how it is to drive."""

    shown: NDArray[np.int64]  # (B,) behavior whose memory it gets
    driven: NDArray[np.int64]  # (B,) behavior it starts on and is labelled by
    wrong: NDArray[np.bool_]  # (B,) whether they differ
    first: NDArray[np.int64]  # (B,) sample of its path it starts at
    carried: NDArray[np.int64]  # (B,) frame before which it is put elsewhere, or NEVER
    expert_only: NDArray[np.bool_]  # (B,)
    wobble_rad: NDArray[np.float64]  # (B,) noise of the expert's waypoint

    @classmethod
    def draw(
        cls,
        behaviors: Behaviors,
        config: TrainConfig,
        rng: np.random.Generator,
        *,
        training: bool,
    ) -> "_Cast":
        total = len(behaviors.world)
        driven = np.repeat(np.arange(total), config.repeats)
        count = len(driven)
        if not training:
            none, zero = np.zeros(count, np.bool_), np.zeros(count, np.int64)
            return cls(driven, driven, none, zero, zero + NEVER, none, np.zeros(count))
        other = (driven + 1 + rng.integers(0, total - 1, count)) % total
        # Another behavior of the same world could overlap.
        elsewhere = behaviors.world[other] != behaviors.world[driven]
        wrong = (rng.random(count) < config.wrong_episodes) & elsewhere
        joining = (rng.random(count) < config.joining_episodes) & ~wrong
        middle = rng.integers(0, behaviors.paths.length[driven] * 85 // 100)
        kidnapped = (rng.random(count) < config.kidnapped_episodes) & ~wrong & ~joining
        carried = rng.integers(4, behaviors.images.shape[1], count)
        return cls(
            shown=np.where(wrong, other, driven),
            driven=driven,
            wrong=wrong,
            first=np.where(joining, middle, 0),
            carried=np.where(kidnapped, carried, NEVER),
            expert_only=rng.random(count) < config.expert_episodes,
            wobble_rad=rng.choice(NOISE_RAD, count),
        )


def _empty(
    count: int,
    longest: int,
    behaviors: Behaviors,
    cast: _Cast,
) -> Rollouts:
    return Rollouts(
        images=np.zeros((count, longest, *behaviors.images.shape[2:]), np.uint8),
        poses=np.zeros((count, longest, 3)),
        waypoint_m=np.zeros((count, longest, 2), np.float32),
        progress=np.zeros((count, longest), np.float32),
        on_route=np.zeros((count, longest), np.bool_),
        frames=np.zeros(count, np.int64),
        shown=cast.shown,
        driven=cast.driven,
        goals=behaviors.paths.goals[cast.shown],
        starts=behaviors.paths.poses[cast.shown, 0],
        carried=cast.carried,
        arrived=np.zeros(count, np.bool_),
        collided=np.zeros(count, np.bool_),
        success=np.zeros(count, np.bool_),
    )


def photograph(
    drives: Drives,
    world: NDArray[np.int64],
    poses: NDArray[np.float64],
    cameras: Appearance,
    supersample: int,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """Images (B, 64, 64, 3) of B poses through their cameras."""
    images = render(
        drives.batch,
        world,
        poses,
        MODEL_CAMERA,
        supersample=supersample,
        height_m=cameras.height_m,
        pitch_px=cameras.pitch_px,
    )
    return appearance.apply(cameras, images, rng)


def _drive(
    vehicle: Vehicle,
    controller: RmpController,
    drives: Drives,
    rows: NDArray[np.intp],
    world: NDArray[np.int64],
    waypoint: NDArray[np.float64],
    steps: int,
) -> NDArray[np.bool_]:
    """Drive the robots in `rows` to their waypoints for some steps; whether each collided."""
    robot = vehicle.robot
    hit = np.zeros(len(rows), np.bool_)
    speed, yaw_rate = np.zeros((2, len(vehicle.poses)))
    target = geometry.from_frame(vehicle.poses[rows], waypoint)
    for _ in range(steps):
        poses = vehicle.poses[rows]
        scans = scan(drives.batch, world[rows], poses, robot)
        motion = Motion(vehicle.speed_mps[rows], vehicle.steer_rad[rows])
        motion = controller.step(motion, geometry.to_frame(poses, target), scans)
        motion = limit(motion, scans, robot)
        going, turning = twist(motion, robot)
        speed[rows], yaw_rate[rows] = np.where(hit, 0.0, going), turning
        vehicle.step(speed, yaw_rate)
        clearance = drives.clearance.at(world[rows], vehicle.poses[rows, :2])
        hit |= clearance < robot.body_radius_m
    return hit


def _jitter(
    drives: Drives,
    world: NDArray[np.int64],
    poses: NDArray[np.float64],
    config: TrainConfig,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Starts near `poses` (B, 3), free of collision and in sight of where they should be."""
    starts = poses.copy()
    missing = np.arange(len(poses))
    for attempt in range(8):
        scale = 1.0 - attempt / 8.0  # tight places take a smaller jitter
        offset = rng.normal(0.0, scale * config.jitter_m, (len(missing), 2))
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        offset *= np.minimum(1.0, 1.0 / np.maximum(distance, 1e-9))  # at most 1 m
        turned = rng.normal(0.0, scale * config.jitter_rad, (len(missing), 1))
        proposed = poses[missing] + np.concatenate([offset, turned], axis=1)
        way = poses[missing, None, :2] + np.linspace(0.0, 1.0, 8)[:, None] * offset[:, None]
        along = drives.clearance.at(np.repeat(world[missing], 8), way.reshape(-1, 2))
        along = along.reshape(-1, 8)
        fits = (along[:, -1] > Robot().body_radius_m + 0.03) & (along.min(axis=1) > 0.05)
        starts[missing[fits]] = proposed[fits]
        missing = missing[~fits]
    return starts


def _elsewhere(drives: Drives, world: np.int64, rng: np.random.Generator) -> NDArray[np.float64]:
    """Any pose (3,) on any drive through a world."""
    path = drives.poses[rng.choice(np.flatnonzero(drives.world == world))]
    return np.asarray(path[rng.integers(len(path))])


def _among_bins(
    drives: Drives,
    world: NDArray[np.int64],
    paths: track.Paths,
    first: NDArray[np.int64],
    config: TrainConfig,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Worlds (B,), some exchanged for their twins where no bin stands at the start or the goal."""
    twin = world + drives.twins
    chosen = rng.random(len(world)) < config.bin_episodes
    for end in (paths.poses[np.arange(len(world)), first], paths.goals):
        room, among = (drives.clearance.at(where, end[:, :2]) for where in (world, twin))
        chosen &= among >= np.minimum(room, BIN_AWAY_M)
    return np.where(chosen, twin, world)


def _turn(points: NDArray[np.float64], angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate points (B, 2) by angles (B,)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x, y = points[:, 0], points[:, 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
