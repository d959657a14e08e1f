"""What pybullet shows and collides with: textured triangles, one solid mesh, a planning view."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import numpy as np
import pybullet
from numpy.typing import NDArray

from cbe.geometry import from_frame
from cbe_hil_sim.world import World

MAX_CORNERS = 90_000  # of one pybullet shape; a multiple of 3, well below its limit


@dataclass(frozen=True, slots=True)
class Patch:
    """Triangles under one texture.

    `corners_m` (T, 3, 3) world, counter-clockwise seen from the front; `uv` (T, 3, 2) repeat
    with period 1, v up; `image` (h, w, 3) uint8 RGB.
    """

    corners_m: NDArray[np.float32]
    uv: NDArray[np.float32]
    image: NDArray[np.uint8]

    @classmethod
    def box(
        cls,
        pose: NDArray[np.floating],
        size_m: tuple[float, float, float],
        image: NDArray[np.uint8],
    ) -> Self:
        """A box that stands on the floor at `pose` (3,), every face showing the whole image."""
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]], np.float32)
        half = 0.5 * np.array(size_m)
        faces = []
        for axis in range(3):
            for sign in (1.0, -1.0):
                face = np.empty((6, 3))
                face[:, axis] = sign
                # Counter-clockwise from outside: the next two axes, mirrored for the far face.
                face[:, (axis + 1) % 3] = 2.0 * square[:, 0] - 1.0
                face[:, (axis + 2) % 3] = sign * (2.0 * square[:, 1] - 1.0)
                faces.append(face * half + [0.0, 0.0, half[2]])
        corners = np.concatenate(faces)  # (36, 3)
        corners[:, :2] = from_frame(np.asarray(pose, np.float64), corners[:, :2])
        return cls(
            corners.astype(np.float32).reshape(12, 3, 3),
            np.tile(square, (6, 1)).reshape(12, 3, 2),
            image,
        )

    def show(self, client: int, *, double_sided: bool = False) -> None:
        """Load it into a pybullet client, for its cameras."""
        with tempfile.TemporaryDirectory(prefix="cbe-texture-") as folder:
            # pybullet reads textures from files alone, and BMP is the quickest to write.
            path = str(Path(folder) / "texture.bmp")
            cv2.imwrite(path, self.image[..., ::-1])
            texture = pybullet.loadTexture(path, physicsClientId=client)
        all_corners, all_uv = self.corners_m, self.uv
        if double_sided:
            # Bullet's own flag for it has no effect on TinyRenderer, which culls the backs.
            all_corners = np.concatenate([all_corners, all_corners[:, ::-1]])
            all_uv = np.concatenate([all_uv, all_uv[:, ::-1]])
        for part in _parts(len(all_corners)):
            corners = all_corners[part]
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH,
                vertices=corners.reshape(-1, 3).tolist(),  # (T * 3, 3)
                uvs=all_uv[part].reshape(-1, 2).tolist(),  # (T * 3, 2)
                normals=np.repeat(_normals(corners), 3, axis=0).tolist(),
                indices=list(range(3 * len(corners))),
                rgbaColor=[1.0, 1.0, 1.0, 1.0],
                physicsClientId=client,
            )
            body = pybullet.createMultiBody(
                baseVisualShapeIndex=shape, useMaximalCoordinates=True, physicsClientId=client
            )
            pybullet.changeVisualShape(body, -1, textureUniqueId=texture, physicsClientId=client)


@dataclass(frozen=True, slots=True)
class Scene:
    """A world for pybullet, its floor at z = 0.

    `solid_m` (T, 3, 3) are the triangles that body and scan meet; `planning` is the 2.5-D world
    whose free space paths are sought in. `ambient` is the share of light that comes from
    everywhere: 1 where the patches carry their shade already.
    """

    name: str
    patches: Sequence[Patch]
    solid_m: NDArray[np.float32]
    planning: World
    double_sided: bool = False
    ambient: float = 1.0


def solidify(solid_m: NDArray[np.float32], client: int) -> list[int]:
    """Load triangles (T, 3, 3) as solid into a pybullet client; the new bodies' ids."""
    bodies = []
    for part in _parts(len(solid_m)):
        corners = solid_m[part].reshape(-1, 3)  # (T * 3, 3)
        # One concave mesh is the fastest thing to scan.
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=corners.tolist(),
            indices=list(range(len(corners))),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=client,
        )
        bodies.append(
            pybullet.createMultiBody(baseCollisionShapeIndex=shape, physicsClientId=client)
        )
    return bodies


def _parts(triangles: int) -> Iterator[slice]:
    """Slices of a triangle list that one pybullet shape can hold."""
    step = MAX_CORNERS // 3
    return (slice(first, first + step) for first in range(0, triangles, step))


def _normals(corners_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit normals (T, 3) of triangles (T, 3, 3)."""
    edges = corners_m[:, 1:] - corners_m[:, :1]
    normal = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(normal / np.maximum(length, 1e-12), np.float32)
