"""A field of displacements along the normals of a body's cells."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.motion.body_cells import BodyCells


def normal_field(cells: BodyCells) -> Array:
    """A field (C, 12, 1) of 1 mm outwards."""
    slopes = cells.gradients(cells.normals).reshape(-1, 9)
    return np.hstack([cells.normals, slopes])[:, :, None]
