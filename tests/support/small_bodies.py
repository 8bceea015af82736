"""A small mesh and a small cloud with every field filled, to write and read back."""

from __future__ import annotations

import numpy as np
from made_bodies import ellipsoid, mesh_of

from bodyscan.mesh.body import BodyCloud, BodyMesh


def ball(resolution: int = 20, radius_mm: float = 120.0) -> BodyMesh:
    """A ball that stands on the floor off the middle; its lowest part was measured by nobody."""
    vertices, faces = ellipsoid((radius_mm,) * 3, (30.0, -40.0, radius_mm), resolution)
    rng = np.random.default_rng(1)
    sigma_mm = rng.uniform(0.01, 0.3, len(vertices)).astype(np.float32)
    sigma_mm[vertices[:, 2] < 40.0] = np.nan
    vertices += rng.normal(0.0, 1e-3, vertices.shape)
    return mesh_of(vertices, faces, colours=rng.integers(0, 256, vertices.shape), sigma_mm=sigma_mm)


def points() -> BodyCloud:
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(500, 3))
    return BodyCloud(
        rng.uniform(-900.0, 1900.0, (500, 3)),
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        rng.uniform(0.01, 1.0, 500).astype(np.float32),
        rng.integers(0, 256, (500, 3)).astype(np.uint8),
        rng.integers(1, 13, 500).astype(np.uint8),
    )
