"""The body model: a cloud, and the closed mesh made from it. Rig frame, mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.mesh.topology import face_areas


@dataclass(frozen=True, eq=False)
class BodyCloud:
    """N points of a body.

    points: (N, 3) float64, mm.  normals: (N, 3) float32, unit, outward.
    sigma_mm: (N,) float32, standard deviation along the normal.
    colours: (N, 3) uint8, red, green, blue.  pairs_seen: (N,) uint8, how many pairs measured it.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    sigma_mm: NDArray[np.float32]
    colours: NDArray[np.uint8]
    pairs_seen: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """A closed triangle mesh with outward faces.

    vertices: (V, 3) float64, mm.  faces: (F, 3) int64.  normals: (V, 3) float32, unit, outward.
    colours: (V, 3) uint8.  sigma_mm: (V,) float32, NaN on filled vertices.
    filled: (F,) bool, faces that no pair measured and that were made up to close the mesh.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float32]
    colours: NDArray[np.uint8]
    sigma_mm: NDArray[np.float32]
    filled: NDArray[np.bool_]

    @property
    def filled_share(self) -> float:
        """Share of the surface's area that was made up."""
        area = face_areas(self.vertices, self.faces)
        return float(area[self.filled].sum() / area.sum()) if area.any() else 0.0
