import cv2
import numpy as np
import pytest
from scipy import ndimage

from cbe.errors import WorldError
from cbe_hil_sim import textures
from cbe_hil_sim.floorplan import FloorPlan, from_floorplan, from_image, from_polygons, read_map
from cbe_hil_sim.generate import (
    DEPOT_SEEDS,
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    generate,
    is_depot,
    is_hall,
    split_of,
    style_of,
)
from cbe_hil_sim.layout import draw_layout
from cbe_hil_sim.world import BLOCKING_HEIGHT_M, RESOLUTION_M

SEEDS = [*range(20), 100_000, 108_999, 200_000, 209_999, *DEPOT_SEEDS["train"][:5]]


def layout_of(seed, *more):
    """As `generate` draws it for `more` of 7."""
    return draw_layout(np.random.default_rng([seed, *more]), style_of(seed))


@pytest.fixture(scope="module", params=SEEDS)
def world(request):
    return generate(request.param)


def test_all_clear_floor_is_one_connected_part(world):
    _, parts = ndimage.label(world.clearance_m >= 0.3)
    assert parts == 1


def test_outer_walls_close_the_world(world):
    top = world.solid_top_m
    edge = np.concatenate([top[0], top[-1], top[:, 0], top[:, -1]])
    np.testing.assert_allclose(edge, world.ceiling_m)


def test_building_is_between_100_and_700_m2_a_depot_up_to_800(world):
    largest_m2 = 800.0 if world.name.startswith("depot") else 700.0
    width_m, height_m = world.size_m
    assert width_m * height_m >= 100.0
    assert (world.solid_top_m < world.ceiling_m).sum() * RESOLUTION_M**2 <= largest_m2


def test_spans_hang_above_what_stands_and_below_the_ceiling(world):
    hanging = world.span_top_m > 0.0
    bottom, top = world.span_bottom_m[hanging], world.span_top_m[hanging]
    assert hanging.any()
    assert (bottom >= world.solid_top_m[hanging]).all()
    assert (bottom < top).all()
    assert (top <= world.ceiling_m + 1e-5).all()


def test_surface_rows_are_in_range(world):
    rows = len(world.surfaces.texture)
    grids = (world.solid_side, world.solid_cap, world.span_surface, world.floor_surface)
    assert max(int(grid.max()) for grid in (*grids, world.ceiling_surface)) < rows
    assert 0 <= world.surfaces.texture.min() <= world.surfaces.texture.max() < len(world.textures)
    assert (world.surfaces.size_m > 0.0).all()
    assert 0.0 < world.surfaces.tint.min() < world.surfaces.tint.max() <= 1.6


def test_world_has_furniture_of_many_heights(world):
    standing = (world.solid_top_m > 0.0) & (world.solid_top_m < world.ceiling_m - 0.01)
    assert len(np.unique(np.round(world.solid_top_m[standing], 2))) > 10


def test_same_seed_gives_the_same_world():
    first, second = generate(7), generate(7)
    np.testing.assert_array_equal(first.solid_top_m, second.solid_top_m)
    np.testing.assert_array_equal(first.solid_side, second.solid_side)
    np.testing.assert_array_equal(first.surfaces.tint, second.surfaces.tint)
    assert first.textures is second.textures


def test_different_seeds_give_different_worlds():
    assert generate(7).solid_top_m.shape != generate(8).solid_top_m.shape


@pytest.mark.parametrize("seed", range(40))
def test_doors_are_wide_enough_and_free_on_both_sides(seed):
    world = generate(seed)
    layout = layout_of(seed, 7)
    assert layout.shape == world.solid_top_m.shape
    for opening in layout.openings:
        assert opening.width * RESOLUTION_M >= 0.8 - 1e-9
        lane = opening.rect.grown(20, -3) if opening.along_x else opening.rect.grown(-3, 20)
        wall = world.solid_top_m >= world.ceiling_m - 0.01
        assert not (world.blocked & ~wall)[lane.slices].any()
        assert not world.blocked[opening.rect.slices].any()


@pytest.mark.parametrize("seed", range(40))
def test_every_room_of_a_layout_is_joined_to_every_other(seed):
    layout = layout_of(seed)
    reached, grown = {0}, True
    while grown:
        pairs = [{o.first, o.second} for o in layout.openings]
        more = {room for pair in pairs if pair & reached for room in pair}
        grown = not more <= reached
        reached |= more
    assert reached == set(range(len(layout.rooms)))


def test_every_third_world_is_of_halls_large_high_and_bare():
    halls = [seed for seed in range(30) if is_hall(seed)]
    assert len(halls) == 10
    worlds = [generate(seed) for seed in halls]
    assert all(world.name.startswith("hall") for world in worlds)
    assert max(world.ceiling_m for world in worlds) > 5.0
    plain = textures.FAMILIES["plain_ceiling"]
    floors = [world.surfaces.texture[world.floor_surface[~world.blocked]] for world in worlds]
    bare = [np.isin(floor, np.arange(plain.start, plain.stop)).mean() for floor in floors]
    assert np.median(bare) > 0.5


def test_most_halls_have_tape_on_their_floors():
    taped = []
    for seed in filter(is_hall, range(30)):
        rooms = layout_of(seed, 7).rooms
        world = generate(seed)
        taped.append(len(np.unique(world.floor_surface[~world.blocked])) > len(rooms) + 2)
    assert 5 <= sum(taped) < 10


def test_depots_are_mostly_one_large_room_with_racks_out_of_reach():
    seeds = DEPOT_SEEDS["validation"][:12]
    assert not any(is_hall(seed) for seed in seeds)
    layouts, worlds = [layout_of(seed, 7) for seed in seeds], [generate(seed) for seed in seeds]
    assert all(world.name.startswith("depot") for world in worlds)
    largest_m2 = [max(room.rect.area_m2 for room in layout.rooms) for layout in layouts]
    assert np.median(largest_m2) > 250.0
    racks = [(world.span_top_m > 3.0) & (world.span_bottom_m < 2.5) for world in worlds]
    assert np.median([rack.sum() * RESOLUTION_M**2 for rack in racks]) > 2.0


def test_racks_of_depots_stand_in_rows_and_most_floors_have_lanes_from_wall_to_wall():
    filled, laned = [], 0
    for seed in DEPOT_SEEDS["validation"][:12]:
        room = max(layout_of(seed, 7).rooms, key=lambda room: room.rect.area_m2).rect
        world = generate(seed)
        racks, floor = (world.span_top_m > 3.0)[room.slices], world.floor_surface[room.slices]
        filled.append(max(racks.mean(axis=axis)[40:-40].max() for axis in (0, 1)))
        common = np.bincount(floor.ravel()).argmax()
        laned += any((floor != common).mean(axis=axis).max() > 0.9 for axis in (0, 1))
    assert np.median(filled) > 0.45
    assert laned >= 6


def test_no_world_to_test_in_is_a_depot():
    assert not any(is_depot(seed) for seed in TEST_SEEDS)


def test_seed_ranges_of_the_splits_do_not_meet():
    assert not set(TRAIN_SEEDS) & set(VALIDATION_SEEDS)
    assert not set(TEST_SEEDS) & (set(TRAIN_SEEDS) | set(VALIDATION_SEEDS))
    assert split_of(TRAIN_SEEDS[-1]) == "train"
    assert split_of(VALIDATION_SEEDS[0]) == "validation"
    assert split_of(TEST_SEEDS[-1]) == "test"


@pytest.mark.parametrize("seed", [-1, 110_000, 199_999, 210_000])
def test_seed_outside_every_split_is_refused(seed):
    with pytest.raises(WorldError, match=str(seed)):
        generate(seed)


def test_banks_share_their_families_but_no_texture():
    banks = [textures.bank(split) for split in textures.SPLITS]
    assert {bank.shape for bank in banks} == {(len(banks[0]), 128, 128, 3)}
    assert textures.FAMILIES["photo"].stop == len(banks[0])
    seen = [{image.tobytes() for image in bank} for bank in banks]
    assert not seen[0] & seen[1]
    assert not seen[0] & seen[2]
    assert not seen[1] & seen[2]


def test_bank_does_not_change_between_calls():
    cached = textures.bank("validation")
    np.testing.assert_array_equal(textures.bank.__wrapped__("validation"), cached)
    assert not cached.flags.writeable


def test_unknown_split_is_refused():
    with pytest.raises(WorldError, match="holdout"):
        textures.bank("holdout")


def _plan_image():
    """Two rooms of 3 m joined by a 1 m door, at 0.025 m a pixel, an island in the lower left."""
    image = np.full((130, 250), 254, np.uint8)
    image[:4] = image[-4:] = image[:, :4] = image[:, -4:] = 0
    image[:45, 123:127] = image[85:, 123:127] = 0
    image[90:106, 40:56] = 0
    return image


def test_occupancy_image_becomes_a_closed_world_with_its_door_and_furniture():
    world = from_floorplan(from_image(_plan_image(), 0.025, origin_m=(-2.0, 1.0)))
    x, y = 3.125 - 2.0, 1.0 + (130 - 65) * 0.025
    clearance = world.clearance_at(np.array([[x, y], [x, y + 1.2], [-0.8, 1.8]]))
    assert clearance[0] > 0.4  # the door
    assert clearance[1] == 0.0  # the wall beside it
    assert clearance[2] == 0.0  # the island: rows count from the top of the image
    row, column = world.cells(np.array([-0.8, 1.8]))
    assert 0.0 < world.solid_top_m[row, column] < world.ceiling_m
    assert ndimage.label(world.clearance_m > 0.3)[1] == 1
    edge = [world.solid_top_m[0], world.solid_top_m[:, -1]]
    assert min(e.min() for e in edge) >= np.float32(world.ceiling_m)
    assert len(np.unique(world.floor_surface)) == 2


def test_thin_walls_survive_resampling():
    image = np.full((100, 100), 254, np.uint8)
    image[:, 50] = 0
    world = from_floorplan(from_image(image, 0.02))
    assert ndimage.label(~world.blocked)[1] == 2


def test_coarse_plan_keeps_its_size():
    world = from_floorplan(FloorPlan(np.zeros((10, 20), np.bool_), 0.2))
    assert (~world.blocked).sum() * RESOLUTION_M**2 == pytest.approx(8.0)


def test_polygons_become_rooms_and_obstacles():
    room = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
    ell = np.array([[3.5, 0.0], [8.0, 0.0], [8.0, 6.0], [6.0, 6.0], [6.0, 2.0], [3.5, 2.0]])
    column = np.array([[1.0, 1.0], [1.5, 1.0], [1.5, 1.5], [1.0, 1.5]])
    plan = from_polygons([room, ell], [column])
    assert plan.occupied.shape == (120, 160)
    free_m2 = (~plan.occupied).sum() * RESOLUTION_M**2
    assert free_m2 == pytest.approx(12.0 + 17.0 - 1.0 - 0.25, abs=0.2)
    world = from_floorplan(plan)
    points = np.array([[1.25, 1.25], [7.0, 5.0], [5.0, 4.0]])
    np.testing.assert_array_equal(world.clearance_at(points) > 0.2, [False, True, False])


def test_map_server_files_are_read(tmp_path):
    cv2.imwrite(str(tmp_path / "plan.pgm"), _plan_image())
    (tmp_path / "plan.yaml").write_text(
        "image: plan.pgm\nresolution: 0.025 # m\norigin: [-2.0, 1.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    plan = read_map(tmp_path / "plan.yaml")
    direct = from_image(_plan_image(), 0.025, origin_m=(-2.0, 1.0))
    np.testing.assert_array_equal(plan.occupied, direct.occupied)
    assert (plan.resolution_m, plan.origin_m) == (0.025, (-2.0, 1.0))
    assert from_floorplan(tmp_path / "plan.yaml").name == "plan"


GOOD = {"image": "plan.pgm", "resolution": "0.05", "origin": "[0, 0, 0]"}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"image": "gone.pgm"}, "gone.pgm"),
        ({"resolution": "wide"}, "resolution: wide"),
        ({"resolution": "0"}, "resolution is 0.0"),
        ({"resolution": "NaN"}, "resolution: NaN"),
        ({"origin": "[0, 0]"}, "origin"),
        ({"origin": "[0, 0, 0.5]"}, "0.5 rad"),
        ({"free_thresh": "7"}, "free threshold is 7"),
    ],
)
def test_bad_map_files_are_refused_with_what_was_found(tmp_path, change, told):
    cv2.imwrite(str(tmp_path / "plan.pgm"), _plan_image())
    path = tmp_path / "plan.yaml"
    path.write_text("\n".join(f"{k}: {v}" for k, v in (GOOD | change).items()))
    with pytest.raises(WorldError, match=told.replace("[", r"\[")):
        read_map(path)


def test_damaged_image_and_missing_map_are_refused(tmp_path):
    (tmp_path / "plan.pgm").write_bytes(b"P5\n10 10\n255\nxx")
    path = tmp_path / "plan.yaml"
    path.write_text("\n".join(f"{k}: {v}" for k, v in GOOD.items()))
    with pytest.raises(WorldError, match=r"damaged|free space"):
        read_map(path)
    with pytest.raises(WorldError, match=r"gone\.yaml"):
        from_floorplan(tmp_path / "gone.yaml")


def test_plan_without_free_space_is_refused():
    with pytest.raises(WorldError, match="free space"):
        from_image(np.zeros((5, 5), np.uint8), 0.05)


def test_pictures_hang_above_the_mast_and_block_nothing():
    world = generate(0)
    high = (world.span_top_m > 0.0) & (world.span_bottom_m >= BLOCKING_HEIGHT_M)
    assert (high & ~world.blocked).sum() > 100
