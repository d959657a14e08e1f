import logging

import cv2
import numpy as np
import pytest

pytest.importorskip("pybullet")

from cbe.errors import WorldError
from cbe_hil_sim.astar import plan
from cbe_hil_sim.bullet import BulletBackend
from cbe_hil_sim.meshscene import load_scene
from cbe_hil_sim.wavefront import read_obj

FLOOR_M = 0.03
WALL_RGB, FLOOR_RGB = (200, 40, 40), (40, 160, 60)


class Mesh:
    """Quads of one OBJ file with its material."""

    def __init__(self):
        self.lines, self.count = [], 0

    def quad(self, *corners):
        self.lines += ["v " + " ".join(map(str, corner)) for corner in corners]
        self.lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
        first = self.count + 1
        self.lines.append("f " + " ".join(f"{n}/{n}" for n in range(first, first + 4)))
        self.count += 4

    def level(self, x0, y0, x1, y1, z):
        self.quad((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))

    def wall(self, x0, y0, x1, y1, low=FLOOR_M, high=2.5):
        self.quad((x0, y0, low), (x1, y1, low), (x1, y1, high), (x0, y0, high))

    def save(self, folder, name, texture):
        (folder / f"{name}.mtl").write_text(f"newmtl m\nKd 1 1 1\nmap_Kd {texture}\n")
        head = [f"mtllib {name}.mtl", "usemtl m"]
        (folder / f"{name}.obj").write_text("\n".join([*head, *self.lines]) + "\n")


@pytest.fixture
def folder(tmp_path):
    """Two rooms of 4 x 3 m with a door, a table, a seam in the floor, and a closet apart."""
    floor, walls = Mesh(), Mesh()
    floor.level(0, 0, 2, 3, FLOOR_M)
    floor.level(2.02, 0, 8, 3, FLOOR_M)  # 2 cm of nothing
    floor.level(1, 1, 1.6, 1.6, FLOOR_M + 0.02)  # rug
    floor.level(9, 0, 10, 1, FLOOR_M)  # the closet's
    for x0, y0, x1, y1 in ((0, 0, 8, 0), (8, 0, 8, 3), (8, 3, 0, 3), (0, 3, 0, 0)):
        walls.wall(x0, y0, x1, y1)
    walls.wall(4, 0, 4, 1)
    walls.wall(4, 2, 4, 3)
    walls.wall(4, 1, 4, 2, low=2.1)  # lintel
    walls.level(5, 1.0, 6, 2.0, 0.75)  # table top without legs: no scan sees it
    for texture, colour in (("wall.png", WALL_RGB), ("floor.png", FLOOR_RGB)):
        cv2.imwrite(str(tmp_path / texture), np.full((8, 8, 3), colour[::-1], np.uint8))
    floor.save(tmp_path, "floor", "floor.png")
    walls.save(tmp_path, "walls", "wall.png")
    return tmp_path


def free(scene, x, y):
    row, column = scene.planning.cells(np.array([x, y]))
    return not scene.planning.blocked[row, column]


def test_floor_is_brought_to_zero(folder):
    scene = load_scene(folder)
    heights = np.concatenate([patch.corners_m[..., 2].ravel() for patch in scene.patches])
    assert heights.min() == pytest.approx(0.0, abs=0.011)
    assert heights.max() == pytest.approx(2.5 - FLOOR_M, abs=0.011)


def test_free_space_is_the_floor_without_walls_and_tables(folder):
    scene = load_scene(folder)
    assert free(scene, 0.5, 0.5)
    assert free(scene, 7.5, 2.5)
    assert not free(scene, 4.0, 0.5)
    assert not free(scene, 5.5, 1.5)
    assert not free(scene, -0.2, 1.0)


def test_seam_and_rug_are_no_obstacles(folder):
    scene = load_scene(folder)
    assert free(scene, 2.01, 1.5)
    assert free(scene, 1.3, 1.3)
    assert free(scene, 1.01, 1.3)


def test_floor_apart_from_the_largest_is_not_free(folder):
    assert not free(load_scene(folder), 9.5, 0.5)


def test_path_leads_through_the_door(folder):
    path = plan(load_scene(folder).planning, np.array([1.0, 2.5]), np.array([7.0, 0.5]))
    at_door = path[np.abs(path[:, 0] - 4.0).argmin()]
    assert 1.0 < at_door[1] < 2.0


def test_camera_scan_and_body_meet_the_mesh(folder):
    with BulletBackend(load_scene(folder)) as backend:
        backend.reset(np.array([[1.0, 0.5, 0.0]]))
        seen = backend.observe()
        assert seen.scans_m[0, 120] == pytest.approx(4.0 - 1.08, abs=0.01)
        image = seen.images[0].astype(float)
        for region, colour in ((image[60, 80], WALL_RGB), (image[-1, 80], FLOOR_RGB)):
            assert np.corrcoef(region, colour)[0, 1] > 0.99
        for _ in range(10):
            backend.step(np.array([0.5]), np.array([0.0]))
        assert not backend.collided[0]  # over rug and seam
        backend.reset(np.array([[4.6, 1.5, 0.0]]))
        for _ in range(15):
            backend.step(np.array([0.5]), np.array([0.0]))
        assert backend.collided[0]  # the table's edge


def test_collision_mesh_replaces_the_visual_one(folder):
    extra = Mesh()
    extra.level(0, 0, 8, 3, FLOOR_M)
    for x0, y0, x1, y1 in ((0, 0, 8, 0), (8, 0, 8, 3), (8, 3, 0, 3), (0, 3, 0, 0)):
        extra.wall(x0, y0, x1, y1)
    extra.save(folder, "collision", "none.png")
    scene = load_scene(folder)
    assert free(scene, 4.0, 0.5)
    assert len(scene.patches) == 2


def test_missing_texture_is_shown_plain_and_told(folder, caplog):
    (folder / "wall.png").unlink()
    with caplog.at_level(logging.WARNING):
        scene = load_scene(folder)
    assert "wall.png" in caplog.text
    assert any((patch.image == patch.image[0, 0]).all() for patch in scene.patches)


def test_image_of_one_bit_a_pixel_keeps_its_colours(folder):
    # One bit a pixel, which pybullet itself loads blank.
    bilevel = np.where(np.eye(4) > 0.0, 255, 0).astype(np.uint8)
    cv2.imwrite(str(folder / "wall.png"), bilevel, [cv2.IMWRITE_PNG_BILEVEL, 1])
    images = [patch.image for patch in load_scene(folder).patches]
    assert any(np.array_equal(image[..., 0], bilevel) for image in images if len(image) == 4)


def test_missing_folder_is_refused(tmp_path):
    with pytest.raises(WorldError, match="no scene folder"):
        load_scene(tmp_path / "nowhere")


def test_folder_without_meshes_is_refused(tmp_path):
    with pytest.raises(WorldError, match="holds no visual OBJ"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("v 1 2 three", "cannot read"),
        ("v 1 2", "expected 3 numbers"),
        ("v 1 2 nan", "not finite"),
        ("f 1 2 99999", "beyond"),
        ("f 1 2 -99999", "beyond"),
        ("f a b c", "cannot read"),
    ],
)
def test_damaged_file_is_refused_with_its_name(folder, line, reason):
    path = folder / "walls.obj"
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(WorldError, match=rf"walls\.obj.*{reason}"):
        load_scene(folder)


def test_mesh_in_millimetres_is_refused(folder):
    path = folder / "walls.obj"
    path.write_text(path.read_text() + "v 8000 0 0\nv 0 3000 0\nv 0 0 2500\nf -3 -2 -1\n")
    with pytest.raises(WorldError, match="in metres"):
        load_scene(folder)


def test_polygons_and_relative_indices_become_triangles(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 2 0\nf -5//1 -4//1 -3//1 -2//1 5\n")
    (triangles,) = read_obj(path)
    assert triangles.corners.shape == (3, 3, 3)
    assert triangles.corners[2, 2].tolist() == [0.0, 2.0, 0.0]
    assert (triangles.uv == 0.0).all()
