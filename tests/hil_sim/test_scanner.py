"""The scanner against brute-force intersection with every cell's square."""

import numpy as np
from numpy.typing import NDArray

from cbe.robot import Robot
from cbe_hil_sim.scanner import scan
from cbe_hil_sim.world import Surfaces, World
from cbe_hil_sim.worldbatch import WorldBatch

ROBOT = Robot()
CELL_M = 0.25


def room(seed: int, rows: int = 24, columns: int = 60) -> World:
    """Return a walled room with solids and spans, some above and some below the scan."""
    random = np.random.default_rng(seed)
    solid, bottom, top = (np.zeros((rows, columns), np.float32) for _ in range(3))
    pick = random.random((rows, columns))
    solid[pick < 0.03] = 0.5
    solid[(pick > 0.03) & (pick < 0.06)] = 0.1
    bottom[(pick > 0.06) & (pick < 0.09)], top[(pick > 0.06) & (pick < 0.09)] = 0.7, 0.75
    bottom[(pick > 0.09) & (pick < 0.11)], top[(pick > 0.09) & (pick < 0.11)] = 0.05, 0.4
    solid[[0, -1]] = solid[:, [0, -1]] = 2.5
    zero = np.zeros((rows, columns), np.uint16)
    one = np.ones((1, 3), np.float32)
    surfaces = Surfaces(np.zeros(1, np.int32), one, one[:, :2], one)
    return World(
        solid, bottom, top, zero, zero, zero, zero, zero, 2.5, surfaces,
        np.zeros((1, 128, 128, 3), np.uint8), origin_m=(2.0, -3.0), resolution_m=CELL_M,
    )  # fmt: skip


def brute_force(world: World, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Nearest distance (rays,) to any square the scan can see."""
    seen = world.solid_top_m >= ROBOT.scan_height_m
    seen |= (world.span_bottom_m <= ROBOT.scan_height_m) & (world.span_top_m >= ROBOT.scan_height_m)
    row, column = np.nonzero(seen)
    low = np.array(world.origin_m) + np.column_stack([column, row]) * CELL_M  # (K, 2)
    ahead = np.array([np.cos(pose[2]), np.sin(pose[2])]) * ROBOT.scan_x_m
    angle = pose[2] + ROBOT.scan_angle_min_rad
    angle = angle + np.arange(ROBOT.scan_rays) * ROBOT.scan_angle_increment_rad
    ray = np.column_stack([np.cos(angle), np.sin(angle)])[:, None]  # (rays, 1, 2)
    a = (low - pose[:2] - ahead) / ray
    b = (low + CELL_M - pose[:2] - ahead) / ray
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    distance = np.where((enter <= leave) & (leave >= 0), np.maximum(enter, 0.0), np.inf)
    nearest = distance.min(axis=1)
    return np.where(nearest <= ROBOT.scan_range_m, nearest, np.inf)


def test_scan_agrees_with_ray_casting() -> None:
    worlds = [room(seed) for seed in range(4)]
    random = np.random.default_rng(0)
    index = np.repeat(np.arange(4), 10)
    pose = np.column_stack(
        [random.uniform(2.5, 16.5, 40), random.uniform(-2.5, 2.5, 40), random.uniform(-3, 3, 40)]
    )
    scans = scan(WorldBatch.pack(worlds), index, pose, ROBOT)
    exact = np.array([brute_force(worlds[i], p) for i, p in zip(index, pose, strict=True)])
    with np.errstate(invalid="ignore"):
        close = (np.abs(scans - exact) < 1e-3) | (np.isinf(scans) & np.isinf(exact))
    assert close.mean() > 0.999  # rays that graze a corner may differ
    assert np.isinf(exact).any()
    assert (exact > 0).any()


def test_nothing_within_range_reads_infinity() -> None:
    world = room(0, 200, 200)
    for grid in (world.solid_top_m, world.span_top_m):
        grid[:] = 0.0
    pose = np.array([[27.0, 22.0, 0.7]])
    assert np.isposinf(scan(WorldBatch.pack([world]), np.zeros(1, int), pose, ROBOT)).all()


def test_grid_edge_is_solid() -> None:
    world = room(0)
    for grid in (world.solid_top_m, world.span_top_m):
        grid[:] = 0.0
    pose = np.array([[2.0 + 0.5 - ROBOT.scan_x_m, 0.0, np.pi], [-9.0, 0.0, 0.0]])
    pose[0, 0] += 2 * ROBOT.scan_x_m
    scans = scan(WorldBatch.pack([world]), np.zeros(2, int), pose, ROBOT)
    ray = ROBOT.scan_rays // 2
    assert abs(scans[0, ray] - 0.5) < 1e-3
    assert (scans[1] == 0.0).all()


def test_table_top_above_the_scan_is_not_seen() -> None:
    world = room(0)
    for grid in (world.solid_top_m, world.span_top_m, world.span_bottom_m):
        grid[:] = 0.0
    world.span_bottom_m[12, 20], world.span_top_m[12, 20] = 0.7, 0.75
    world.solid_top_m[12, 24] = 0.2
    # Cell (12, 24) starts at x = 8.0 and spans y from 0 to 0.25.
    pose = np.array([[6.0 - ROBOT.scan_x_m, 0.125, 0.0]])
    distance = scan(WorldBatch.pack([world]), np.zeros(1, int), pose, ROBOT)[0]
    assert abs(distance[119:121] - 2.0).max() < 1e-3
