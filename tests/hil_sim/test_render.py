"""The column renderer against brute-force ray casting of every cell's boxes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cbe.camera import MODEL_CAMERA, CameraModel
from cbe.errors import CameraError, WorldError
from cbe.robot import Robot
from cbe_hil_sim.render import render
from cbe_hil_sim.world import Surfaces, World
from cbe_hil_sim.worldbatch import LEVELS, TEXELS, WorldBatch, pyramid

CEILING_M = 2.5
CELL_M = 0.25
SURFACES = 12


GRIDS = (
    "solid_top_m", "span_bottom_m", "span_top_m", "solid_side", "solid_cap", "span_surface",
    "floor_surface", "ceiling_surface",
)  # fmt: skip


def flat_textures() -> NDArray[np.uint8]:
    """Return one plain texture for each surface, no two colours alike under any shade."""
    colours = np.random.default_rng(3).integers(40, 250, (SURFACES, 3)).astype(np.uint8)
    return np.broadcast_to(colours[:, None, None], (SURFACES, 128, 128, 3)).copy()


def small_world(seed: int, textures: NDArray[np.uint8], size_m: float = 0.7) -> World:
    """Return a walled room of 16 x 20 cells, cluttered with solids, tables, lintels, shelves."""
    random = np.random.default_rng(seed)
    shape = (16, 20)
    solid, bottom, top = (np.zeros(shape, np.float32) for _ in range(3))
    for _ in range(9):
        row, column = random.integers(1, 14), random.integers(1, 18)
        solid[row : row + random.integers(1, 3), column : column + random.integers(1, 4)] = (
            random.choice([0.1, 0.4, 0.9, 1.3, CEILING_M])
        )
    for _ in range(9):
        row, column = random.integers(1, 14), random.integers(1, 18)
        here = (slice(row, row + random.integers(1, 3)), slice(column, column + 3))
        bottom[here], top[here] = [(0.65, 0.7), (2.0, CEILING_M), (1.2, 1.5), (0.9, 1.1)][
            random.integers(4)
        ]
    solid[[0, -1]] = solid[:, [0, -1]] = CEILING_M
    top[solid >= bottom] = 0.0
    grids = random.integers(0, SURFACES, (5, *shape)).astype(np.uint16)
    surfaces = Surfaces(
        texture=np.arange(SURFACES, dtype=np.int32),
        origin_m=random.uniform(-1.0, 1.0, (SURFACES, 3)).astype(np.float32),
        size_m=np.full((SURFACES, 2), size_m, np.float32),
        tint=random.uniform(0.5, 1.2, (SURFACES, 3)).astype(np.float32),
    )
    return World(
        solid, bottom, top, grids[0], grids[1], grids[2], grids[3], grids[4], CEILING_M,
        surfaces, textures, origin_m=(-1.5, 0.75), resolution_m=CELL_M,
    )  # fmt: skip


def brute_force(
    world: World,
    camera_pose: NDArray[np.float64],
    camera_z_m: float,
    camera: CameraModel,
    cy: float,
) -> NDArray[np.float64]:
    """Cast one ray a pixel at every box of the world; returns RGB (h, w, 3)."""
    left = (camera.cx - (np.arange(camera.width) + 0.5)) / camera.fx
    up = (cy - (np.arange(camera.height) + 0.5)) / camera.fy
    cos, sin = np.cos(camera_pose[2]), np.sin(camera_pose[2])
    direction = np.empty((camera.height, camera.width, 3))
    direction[..., 0] = cos - sin * left
    direction[..., 1] = sin + cos * left
    direction[..., 2] = up[:, None]
    rays = direction.reshape(-1, 3)  # (h * w, 3)
    eye = np.array([camera_pose[0], camera_pose[1], camera_z_m])

    rays[rays == 0.0] = 1e-9  # a level ray
    depth = np.where(rays[:, 2] < 0, -eye[2], CEILING_M - eye[2]) / rays[:, 2]
    axis = np.full(len(rays), 2)
    point = eye + depth[:, None] * rays
    cells = world.cells(point)
    surface = np.where(rays[:, 2] < 0, world.floor_surface[cells], world.ceiling_surface[cells])
    upper = rays[:, 2] < 0
    for row, column in np.ndindex(world.solid_top_m.shape):
        low = np.array(world.origin_m) + np.array([column, row]) * CELL_M
        boxes = [(0.0, world.solid_top_m[row, column], True)]
        boxes.append((world.span_bottom_m[row, column], world.span_top_m[row, column], False))
        for z0, z1, is_solid in boxes:
            if z1 <= 0.0:
                continue
            corner0, corner1 = np.array([*low, z0]), np.array([*(low + CELL_M), z1])
            a, b = (corner0 - eye) / rays, (corner1 - eye) / rays
            enter, leave = np.minimum(a, b), np.maximum(a, b)
            near, side = enter.max(axis=1), enter.argmax(axis=1)
            hit = (near < leave.min(axis=1)) & (near > 0) & (near < depth)
            depth[hit], axis[hit], upper[hit] = near[hit], side[hit], rays[hit, 2] < 0
            solid_face = np.where(
                side == 2, world.solid_cap[row, column], world.solid_side[row, column]
            )
            face = solid_face if is_solid else np.full_like(side, world.span_surface[row, column])
            surface[hit] = face[hit]
    point = eye + depth[:, None] * rays
    shade = np.where(upper, 1.0, 0.7)
    shade = np.where(axis == 0, np.where(rays[:, 0] < 0, 0.95, 0.82), shade)
    shade = np.where(axis == 1, np.where(rays[:, 1] < 0, 1.0, 0.88), shade)
    offset = point - world.surfaces.origin_m[surface]
    size = world.surfaces.size_m[surface]
    u = np.where(axis == 0, offset[:, 1], offset[:, 0]) / size[:, 0]
    v = np.where(axis == 2, offset[:, 1], offset[:, 2]) / size[:, 1]
    across = np.minimum((u % 1.0) * 128, 127).astype(int)
    down = np.minimum((1.0 - v % 1.0) * 128, 127).astype(int)
    texel = world.textures[world.surfaces.texture[surface], down, across]
    colour = np.minimum(texel * world.surfaces.tint[surface] * shade[:, None], 255.0)
    return colour.reshape(camera.height, camera.width, 3)


def free_poses(world: World, count: int, seed: int) -> NDArray[np.float64]:
    """Return camera poses (count, 3) in cells that hold nothing."""
    random = np.random.default_rng(seed)
    free = np.argwhere((world.solid_top_m == 0.0) & (world.span_top_m == 0.0))
    cell = free[random.integers(0, len(free), count)]
    inside = random.uniform(0.2, 0.8, (count, 2))
    xy = np.array(world.origin_m) + (cell[:, ::-1] + inside) * CELL_M
    return np.column_stack([xy, random.uniform(-np.pi, np.pi, count)])


def base_pose(camera_pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the robot stands when its camera is at `camera_pose`."""
    pose = camera_pose.copy()
    pose[:, 0] -= Robot().camera_x_m * np.cos(pose[:, 2])
    pose[:, 1] -= Robot().camera_x_m * np.sin(pose[:, 2])
    return pose


def same_share(image: NDArray[np.uint8], exact: NDArray[np.float64]) -> float:
    """Share of pixels whose colour is the same up to rounding."""
    return float((np.abs(image - exact).max(axis=-1) <= 1.0).mean())


def test_every_surface_appears_where_ray_casting_sees_it() -> None:
    camera, textures = MODEL_CAMERA, flat_textures()
    worlds = [small_world(seed, textures) for seed in range(6)]
    batch = WorldBatch.pack(worlds)
    poses = np.concatenate([free_poses(world, 1, 7) for world in worlds])
    images = render(batch, np.arange(6), base_pose(poses), camera, supersample=1)
    for world, pose, image in zip(worlds, poses, images, strict=True):
        exact = brute_force(world, pose, Robot().camera_height_m, camera, camera.cy)
        assert same_share(image, exact) > 0.998


def test_height_and_pitch_move_the_view_as_ray_casting_says() -> None:
    camera, world = replace(MODEL_CAMERA, cx=30.0), small_world(1, flat_textures())
    poses = free_poses(world, 4, 2)
    height_m, pitch_px = np.array([0.5, 0.8, 1.15, 1.4]), np.array([0.0, 3.0, -4.5, 11.0])
    batch = WorldBatch.pack([world])
    images = render(
        batch, np.zeros(4, int), base_pose(poses), camera, supersample=1,
        height_m=height_m, pitch_px=pitch_px,
    )  # fmt: skip
    for pose, height, pitch, image in zip(poses, height_m, pitch_px, images, strict=True):
        exact = brute_force(world, pose, height, camera, camera.cy + pitch)
        assert same_share(image, exact) > 0.998


def test_texels_lie_where_the_mapping_puts_them() -> None:
    # Textures of 24 m keep a texel far wider than a pixel's footprint: level 0 everywhere.
    textures = np.random.default_rng(0).integers(0, 256, (SURFACES, 128, 128, 3)).astype(np.uint8)
    camera, world = MODEL_CAMERA, small_world(4, textures, size_m=24.0)
    camera = replace(camera, width=160, height=160, fx=500.0, fy=500.0, cx=80.0, cy=80.0)
    poses = free_poses(world, 4, 5)
    images = render(
        WorldBatch.pack([world]), np.zeros(4, int), base_pose(poses), camera, supersample=1
    )
    for pose, image in zip(poses, images, strict=True):
        exact = brute_force(world, pose, Robot().camera_height_m, camera, camera.cy)
        assert same_share(image, exact) > 0.99


def test_supersampled_pixel_is_the_mean_of_its_rays() -> None:
    world = small_world(2, flat_textures())
    poses = base_pose(free_poses(world, 3, 1))
    batch, index, camera = WorldBatch.pack([world]), np.zeros(3, int), MODEL_CAMERA
    double = replace(camera, width=128, height=128, fx=36.96, fy=47.36, cx=64.0, cy=64.0)
    fine = render(batch, index, poses, double, supersample=1).astype(float)
    mean = fine.reshape(3, 64, 2, 64, 2, 3).mean(axis=(2, 4))  # (B, h, w, 3)
    assert np.abs(render(batch, index, poses, camera) - mean).max() <= 1.0


def test_fine_texture_far_away_fades_to_its_mean() -> None:
    checks = (np.indices((128, 128)).sum(axis=0) % 2 * 200).astype(np.uint8)
    textures = np.broadcast_to(checks[None, :, :, None], (SURFACES, 128, 128, 3)).copy()
    world = small_world(3, textures, size_m=0.2)
    plain = replace(world, textures=np.full_like(textures, 100))
    poses = base_pose(free_poses(world, 4, 3))
    batch = WorldBatch.pack([world, plain])
    images = [render(batch, np.full(4, i), poses, MODEL_CAMERA).astype(float) for i in (0, 1)]
    assert np.abs(images[0] - images[1]).mean() < 2.0


def test_each_mip_level_keeps_the_textures_mean() -> None:
    textures = np.random.default_rng(1).integers(0, 256, (3, 128, 128, 3)).astype(np.uint8)
    levels = pyramid(textures).reshape(3, TEXELS, 3)  # (T, TEXELS, 3)
    assert np.array_equal(levels[:, 5 * 128 + 9], textures[:, 9, 5])  # column 5, row 9
    start = 0
    for level in range(LEVELS):
        count = (128 >> level) ** 2
        mean = levels[:, start : start + count].mean(axis=1)
        assert np.abs(mean - textures.mean(axis=(1, 2))).max() < 0.6
        start += count


def test_batch_gives_each_pose_the_image_it_has_alone() -> None:
    textures = flat_textures()
    worlds = [small_world(seed, textures) for seed in (0, 1)]
    worlds.append(small_world(2, textures[::-1].copy()))  # a bank of its own
    batch = WorldBatch.pack(worlds)
    index = np.array([2, 0, 1, 2])
    poses = np.concatenate([free_poses(worlds[i], 1, i) for i in index])
    together = render(batch, index, poses, MODEL_CAMERA)
    for i, pose, image in zip(index, poses, together, strict=True):
        alone = render(WorldBatch.pack([worlds[i]]), np.zeros(1, int), pose[None], MODEL_CAMERA)
        assert np.array_equal(alone[0], image)
    assert np.array_equal(together, render(batch, index, poses, MODEL_CAMERA))


def test_pose_off_the_grid_sees_a_wall() -> None:
    world = small_world(0, flat_textures())
    poses = np.array([[-50.0, 3.0, 0.3], [1e6, -1e6, 2.9], [1.0, 4.9, -1.0], [-1.5, 0.75, 0.0]])
    images = render(WorldBatch.pack([world]), np.zeros(4, int), poses, MODEL_CAMERA)
    assert (images[:2].reshape(2, -1, 3).std(axis=1) == 0.0).all()  # (B, h * w, 3)


def test_open_grid_edge_looks_like_a_wall_to_the_ceiling() -> None:
    empty = small_world(0, flat_textures())
    none = np.zeros_like(empty.solid_top_m)
    empty = replace(empty, solid_top_m=none, span_top_m=none, solid_side=none.astype(np.uint16))
    image = render(
        WorldBatch.pack([empty]), np.zeros(1, int), np.array([[1.0, 2.75, 0.0]]), MODEL_CAMERA
    )[0]
    expected = np.minimum(empty.textures[0, 0, 0] * empty.surfaces.tint[0] * 0.82, 255)
    assert np.abs(image[31, 30:34] - expected).max() <= 1.0


def test_world_out_of_range_is_refused() -> None:
    batch = WorldBatch.pack([small_world(0, flat_textures())])
    with pytest.raises(WorldError, match=r"holds worlds 0\.\.0"):
        render(batch, np.array([1]), np.zeros((1, 3)), MODEL_CAMERA)
    with pytest.raises(WorldError, match="NaN"):
        render(batch, np.array([0]), np.full((1, 3), np.nan), MODEL_CAMERA)


def test_fisheye_camera_is_refused() -> None:
    batch = WorldBatch.pack([small_world(0, flat_textures())])
    with pytest.raises(CameraError, match="pinhole"):
        render(batch, np.array([0]), np.zeros((1, 3)), replace(MODEL_CAMERA, model="fisheye"))


def test_surface_without_entry_is_refused() -> None:
    world = small_world(0, flat_textures())
    world = replace(world, solid_cap=world.solid_cap + np.uint16(SURFACES))
    with pytest.raises(WorldError, match="its table has"):
        WorldBatch.pack([world])


def test_more_kinds_of_cells_than_an_index_holds_are_refused() -> None:
    world = small_world(0, flat_textures())
    heights = np.linspace(0.1, 2.0, 300 * 300, dtype=np.float32).reshape(300, 300)
    flat = np.zeros((300, 300), np.uint16)
    empty = np.zeros_like(heights)
    world = replace(
        world, solid_top_m=heights, span_bottom_m=empty, span_top_m=empty, solid_side=flat,
        solid_cap=flat, span_surface=flat, floor_surface=flat, ceiling_surface=flat,
    )  # fmt: skip
    with pytest.raises(WorldError, match=r"has 90000 kinds of cells.*at most 65536"):
        WorldBatch.pack([world])


def test_cells_alike_share_a_kind() -> None:
    world = small_world(0, flat_textures())
    batch = WorldBatch.pack([world, world])
    assert len(batch.kind) == len(batch.skip) == 2 * 16 * 24  # 16 x 20 cells in blocks of 8 x 8
    assert np.isin(world.solid_top_m, batch.heights_m[:, 0]).all()
    assert np.array_equal(batch.kind[: 16 * 24], batch.kind[16 * 24 :])
    plain = replace(world, **{name: np.zeros_like(getattr(world, name)) for name in GRIDS})
    assert len(WorldBatch.pack([plain]).heights_m) == 1
