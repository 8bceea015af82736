"""Depth buffers: the nearest face, or the nearest point, at each pixel of an image.

Two short loops instead of Open3D's ray casting: importing Open3D takes longer than all pictures.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Indices
from bodyscan.compiled import compiled

Numbers = NDArray[np.int32]


@compiled
def find_nearest_faces(pixels: Floats, faces: Indices, height: int, width: int) -> Numbers:
    """Find the index (height, width) of the nearest face at each pixel, -1 where there is none.

    pixels: (V, 3) column, row, depth of vertices; NaN for those behind the camera.
    faces: (F, 3), flat; a face covers the pixels whose centres it contains.
    """
    number = np.full((height, width), -1, np.int32)
    depth = np.full((height, width), np.inf, np.float32)
    for f in range(len(faces)):
        a, b, c = pixels[faces[f, 0]], pixels[faces[f, 1]], pixels[faces[f, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if not abs(area) > 0.0:  # seen edge-on, or not at all
            continue
        for r in range(
            max(0, int(np.ceil(min(a[1], b[1], c[1])))),
            min(height, int(np.floor(max(a[1], b[1], c[1]))) + 1),
        ):
            for k in range(
                max(0, int(np.ceil(min(a[0], b[0], c[0])))),
                min(width, int(np.floor(max(a[0], b[0], c[0]))) + 1),
            ):
                of_b = ((k - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (r - a[1])) / area
                of_c = ((b[0] - a[0]) * (r - a[1]) - (k - a[0]) * (b[1] - a[1])) / area
                away = a[2] + of_b * (b[2] - a[2]) + of_c * (c[2] - a[2])
                if of_b >= 0.0 and of_c >= 0.0 and of_b + of_c <= 1.0 and away < depth[r, k]:
                    number[r, k], depth[r, k] = f, away
    return number


@compiled
def find_nearest_points(pixels: Floats, size: int, height: int, width: int) -> Numbers:
    """Find the index (height, width) of the nearest point at each pixel, -1 where there is none.

    pixels: (N, 3) column, row, depth.
    size: side of the square of pixels that a point covers around its own.
    """
    number = np.full((height, width), -1, np.int32)
    depth = np.full((height, width), np.inf, np.float32)
    for n in range(len(pixels)):
        left = int(np.floor(pixels[n, 0] + 0.5)) - size // 2
        top = int(np.floor(pixels[n, 1] + 0.5)) - size // 2
        for r in range(max(0, top), min(height, top + size)):
            for k in range(max(0, left), min(width, left + size)):
                if pixels[n, 2] < depth[r, k]:
                    number[r, k], depth[r, k] = n, pixels[n, 2]
    return number
