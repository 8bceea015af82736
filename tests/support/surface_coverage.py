"""How much of a known surface a cloud of points covers."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.evaluation.surface import find_covered_spots, sample_surface


def coverage(
    points: Array,
    vertices: Array,
    faces: Indices,
    *,
    within_mm: float = 1.0,
    samples: int = 200_000,
    spacing_mm: float = 2.0,
) -> float:
    """Fraction of a surface's area that the points cover, see `find_covered_spots`."""
    spots, normals = sample_surface(vertices, faces, samples)
    return float(np.mean(find_covered_spots(points, spots, normals, within_mm, spacing_mm)))
