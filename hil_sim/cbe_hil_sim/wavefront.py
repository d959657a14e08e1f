"""Wavefront OBJ + MTL files as triangles by material: what is needed of the format, in numpy."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cbe.errors import WorldError

LOG = logging.getLogger(__name__)
MAX_TEXTURE_PX = 512  # a simulated camera sees no more, and smaller ones alias less
PLAIN_RGB = (0.8, 0.8, 0.8)  # where a file names no usable material


@dataclass(frozen=True, slots=True)
class Material:
    """Diffuse colour (RGB, 0 to 1), or a texture."""

    colour: tuple[float, float, float] = PLAIN_RGB
    texture: Path | None = None

    def image(self) -> NDArray[np.uint8]:
        """Texture (h, w, 3) uint8 RGB; a missing or unreadable one is plain."""
        if self.texture is not None:
            # OpenCV also expands the palettes that pybullet loads blank.
            image = cv2.imread(str(self.texture), cv2.IMREAD_COLOR_RGB)
            if image is not None:
                shrink = MAX_TEXTURE_PX / max(image.shape[:2])
                if shrink < 1.0:
                    image = cv2.resize(
                        image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA
                    )
                return np.asarray(image, np.uint8)
            LOG.warning("no usable texture at %s; it is shown plain", self.texture)
        colour = np.clip(np.array(self.colour) * 255.0, 0.0, 255.0)
        return np.full((4, 4, 3), np.rint(colour), np.uint8)


@dataclass(frozen=True, slots=True)
class Triangles:
    """Corners (T, 3, 3) in the file's units and texture coordinates (T, 3, 2) of one material."""

    material: Material
    corners: NDArray[np.float32]
    uv: NDArray[np.float32]


def read_obj(path: Path) -> list[Triangles]:
    """Read an OBJ file and its materials, polygons cut to triangles.

    WorldError names the file and line of what cannot be read.
    """
    vertices: list[list[float]] = []
    uvs: list[list[float]] = []
    faces: dict[str, list[tuple[int, int]]] = {}  # material to (vertex, uv) by corner
    materials: dict[str, Material] = {}
    current = faces.setdefault("", [])
    for number, words in _statements(path):
        try:
            match words[0]:
                case "v":
                    vertices.append([float(word) for word in words[1:4]])
                case "vt":
                    uvs.append([float(word) for word in words[1:3]])
                case "f":
                    corners = [_corner(word, len(vertices), len(uvs)) for word in words[1:]]
                    for second, third in pairwise(corners[1:]):
                        current += (corners[0], second, third)
                case "usemtl":
                    current = faces.setdefault(" ".join(words[1:]), [])
                case "mtllib":
                    materials |= _read_mtl(path.parent / " ".join(words[1:]))
        except (ValueError, IndexError) as error:
            raise WorldError(f"{path}, line {number}: cannot read {words[:4]} ({error})") from None
    vertex_array = _table(path, vertices, 3)
    uv_array = np.concatenate([_table(path, uvs, 2), np.zeros((1, 2), np.float32)])
    found = []
    for name, corners in faces.items():
        if corners:
            index = np.array(corners)  # (T * 3, 2)
            if not 0 <= index[:, 0].min() <= index[:, 0].max() < len(vertices):
                raise WorldError(f"{path}: a face names a vertex beyond the file's {len(vertices)}")
            found.append(
                Triangles(
                    materials.get(name, Material()),
                    vertex_array[index[:, 0]].reshape(-1, 3, 3),
                    uv_array[np.minimum(index[:, 1], len(uvs))].reshape(-1, 3, 2),
                )
            )
    return found


def _corner(word: str, vertices: int, uvs: int) -> tuple[int, int]:
    """Vertex and uv indices from 0 of "v", "v/vt" or "v/vt/vn"; no uv is index -1, the last."""
    parts = word.split("/")
    vertex = int(parts[0])
    uv = int(parts[1]) if len(parts) > 1 and parts[1] else 0
    # Negative indices count back from the latest.
    return (
        vertex - 1 if vertex > 0 else vertices + vertex,
        uv - 1 if uv >= 0 else uvs + uv,
    )


def _read_mtl(path: Path) -> dict[str, Material]:
    """Materials by name; none if the file is missing, as scans often lose it."""
    if not path.is_file():
        LOG.warning("no material file %s; its surfaces are shown plain", path)
        return {}
    materials: dict[str, Material] = {}
    name = ""
    for number, words in _statements(path):
        known = materials.get(name, Material())
        match words[0]:
            case "newmtl":
                name = " ".join(words[1:])
                materials[name] = Material()
            case "Kd" if len(words) >= 4:
                try:
                    red, green, blue = (float(word) for word in words[1:4])
                except ValueError:
                    raise WorldError(f"{path}, line {number}: Kd takes three numbers") from None
                materials[name] = Material((red, green, blue), known.texture)
            case "map_Kd":
                # Options such as -s come before the file's name.
                file = words[-1] if words[1:2] and words[1].startswith("-") else " ".join(words[1:])
                texture = path.parent / file.replace("\\", "/")
                materials[name] = Material(known.colour, texture)
    return materials


def _statements(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and words of the lines that say something."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise WorldError(f"cannot read {path}: {error.strerror}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words


def _table(path: Path, rows: list[list[float]], width: int) -> NDArray[np.float32]:
    """Rows as a finite array (N, width)."""
    if any(len(row) != width for row in rows):
        raise WorldError(f"{path}: expected {width} numbers a vertex; some have fewer")
    table = np.array(rows, np.float32).reshape(-1, width)
    if not np.isfinite(table).all():
        raise WorldError(f"{path} holds a vertex that is not finite; repair the mesh")
    return table
