"""A body's colours as a texture: a UV atlas, and an image baked from coloured points.

A texture is sRGB to every program. glTF's vertex colours are linear, which some programs ignore.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Bytes, Floats, Indices
from bodyscan.compiled import compiled
from bodyscan.errors import BadInput
from bodyscan.mesh.depth_buffer import find_nearest_faces
from bodyscan.progress import THREADS


@dataclass(frozen=True, eq=False)
class Texture:
    """Colours of a mesh in an image. At seams of the atlas a vertex has several places in it."""

    uv: Floats  # (T, 2) float32, place in the image: 0 to 1, to the right and down
    vertex: Indices  # (T,) index of the vertex at each place
    faces: Indices  # (F, 3) indices into both, in the order of the mesh's faces
    image: Bytes  # (S, S, 3) uint8, red, green, blue

    @cached_property
    def png(self) -> bytes:
        """The image as a PNG file."""
        return bytes(cv2.imencode(".png", self.image[..., ::-1])[1])


def make_texture(
    vertices: Array, faces: Indices, points: Array, colours: Bytes, size: int, *, rest: Array
) -> Texture:
    """Unwrap a mesh and bake the colours (N, 3) of points (N, 3), mm, into an image of so many
    pixels a side.

    rest: (V, 3), the vertices of the shape that is unwrapped: the mesh's own, or those of a template,
        whose atlas all bodies then share.

    Raises BadInput without the package xatlas.
    """
    try:
        import xatlas
    except ImportError as error:
        raise BadInput(
            "a texture needs the package xatlas, which is not installed",
            remedy="pip install 'bodyscan[texture]'",
        ) from error
    atlas = xatlas.Atlas()
    atlas.add_mesh(rest.astype(np.float32), faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding = 1024, 1  # 4 pixels of 4096, for smaller versions of it
    atlas.generate(xatlas.ChartOptions(), packing)
    vertex, corners, uv = atlas[0]
    vertex, corners, pixels = vertex.astype(int), corners.astype(int), size * uv - 0.5
    image = bake(pixels, corners, vertices[vertex], points, colours, size)
    return Texture(uv.astype(np.float32), vertex, corners, image)


def bake(
    pixels: Array, faces: Indices, positions: Array, points: Array, colours: Bytes, size: int
) -> Bytes:
    """Bake colours (N, 3) of points (N, 3) into an image (size, size, 3).

    A pixel on a face has the mean of the four points nearest to its place in space, so that nothing
    shows where charts meet; any other that of the nearest on a face.

    pixels: (T, 2) column and row, and positions: (T, 3) mm, of the faces' (F, 3) corners.
    """
    flat = np.column_stack([pixels, np.zeros(len(pixels))]).astype(np.float32)
    face = find_nearest_faces(flat, faces, size, size)
    origin, slope = _fit_faces(pixels[faces], positions[faces])
    tree, image = cKDTree(points), np.zeros((size, size, 3), np.uint8)
    band = max(1, 1_000_000 // size)
    for top in range(0, size, band):
        rows, columns = np.nonzero(face[top : top + band] >= 0)
        of = face[top + rows, columns]
        place = np.stack([columns, top + rows], axis=1)
        at = origin[of] + np.einsum("nk,nkc->nc", place, slope[of])
        distance, near = tree.query(at, k=5, workers=THREADS)
        image[top + rows, columns] = _blend(np.asarray(distance), np.asarray(near), colours)
    # Beside charts too: filters and smaller versions of the image look there.
    covered = face >= 0
    nearest = cv2.distanceTransformWithLabels(
        np.uint8(255) * ~covered, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    by_label = np.zeros((int(nearest.max()) + 1, 3), np.uint8)
    by_label[nearest[covered]] = image[covered]
    return by_label[nearest]


def _fit_faces(pixels: Array, positions: Array) -> tuple[Array, Array]:
    """Positions as linear functions of pixels on each face: at pixel 0, (F, 3), and by column and
    row, (F, 2, 3). pixels: (F, 3, 2), and positions: (F, 3, 3), of its corners."""
    sides = pixels[:, 1:] - pixels[:, :1]
    slope = np.linalg.pinv(sides) @ (positions[:, 1:] - positions[:, :1])
    return positions[:, 0] - np.einsum("nk,nkc->nc", pixels[:, 0], slope), slope


@compiled
def _blend(distance: Array, near: Indices, colours: Bytes) -> Bytes:
    """Mean colours (M, 3) of all but the last of the points `near` (M, K), nearest first, with weights
    that fall from 1 to 0 at the distance of the last."""
    blended = np.empty((len(near), 3), np.uint8)
    for n in range(len(near)):
        reach, total = distance[n, -1] + 1e-9, 0.0
        sums = np.zeros(3)
        for k in range(near.shape[1] - 1):
            weight = (1.0 - distance[n, k] / reach) ** 2 + 1e-6
            total += weight
            for c in range(3):
                sums[c] += weight * float(colours[near[n, k], c])
        for c in range(3):
            blended[n, c] = np.uint8(sums[c] / total + 0.5)
    return blended
