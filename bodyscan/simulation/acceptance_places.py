"""Where artefacts stand in the scan volume of a simulated acceptance test."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.rig import Volume

SPHERES = (
    ("middle, across", (0.0, 0.0, 0.45), (0.0, 1.0, 0.0)),
    ("middle, upright", (0.0, 0.0, 0.5), (0.0, 0.0, 1.0)),
    ("low, front", (0.25, 0.1, 0.25), (0.6, 0.8, 0.0)),
    ("high, left", (0.0, 0.25, 0.65), (1.0, 0.0, 0.0)),
    ("through the middle", (0.0, -0.1, 0.4), (0.5, 0.5, 0.7)),
)
"""Name; middle in shares of the volume's radius (x, y) and height (z); the way the bar points."""
PLATES = (
    ("middle, facing front", (0.0, 0.0, 0.45), (1.0, 0.0, 0.0)),
    ("left, facing left and back", (-0.1, 0.25, 0.5), (-0.8, 0.6, 0.0)),
    ("low, tilted up", (0.2, -0.1, 0.3), (0.7, -0.4, 0.5)),
)
"""Name, middle, and the way the plate faces."""


def spheres_at(volume: Volume, centres: Array) -> list[tuple[str, RigidTransform]]:
    """`rig_from_artefact` of each place, for centres (N, 3): their first axis points along the bar."""
    middle = centres.mean(axis=0)
    return [(name, _placed(volume, share, way, middle)) for name, share, way in SPHERES]


def plates_at(volume: Volume) -> list[tuple[str, RigidTransform]]:
    """`rig_from_artefact` of each place, for a plate in the plane x = 0 about the origin."""
    return [(name, _placed(volume, share, way, np.zeros(3))) for name, share, way in PLATES]


def _placed(
    volume: Volume,
    share: tuple[float, float, float],
    way: tuple[float, float, float],
    middle: Array,
) -> RigidTransform:
    """The artefact's x axis along `way`, its y axis level, its `middle` where `share` says."""
    x = np.array(way) / np.linalg.norm(way)
    beside = np.cross([0.0, 0.0, 1.0], x)
    y = beside / np.linalg.norm(beside) if np.linalg.norm(beside) > 1e-9 else np.array([0.0, 1, 0])
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)
    height = volume.bottom_mm + share[2] * (volume.top_mm - volume.bottom_mm)
    place = np.array([share[0] * volume.radius_mm, share[1] * volume.radius_mm, height])
    return RigidTransform(rotation, place - rotation @ middle)
