"""Nearest points on a triangle mesh, found by Open3D's ray-casting scene."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Indices


def build_centred_scene(
    vertices: Array, faces: Indices
) -> tuple[o3d.t.geometry.RaycastingScene, Array]:
    """Build a scene of vertices (V, 3) less their mean, as it is float32; also return the mean (3,)."""
    centre = vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor((vertices - centre).astype(np.float32)),
        o3d.core.Tensor(faces.astype(np.uint32)),
    )
    return scene, centre


class NearestSurface:
    """Nearest points on a triangle mesh; vertices (V, 3) mm, faces (F, 3)."""

    def __init__(self, vertices: Array, faces: Indices) -> None:
        self.scene, self.centre = build_centred_scene(vertices, faces)

    def nearest(self, points: Array) -> tuple[Array, Array, Indices]:
        """Find the nearest positions (N, 3) to points (N, 3), their distances (N,) and faces (N,)."""
        if not len(points):
            return points, np.empty(0), np.empty(0, np.int64)
        centred = (points - self.centre).astype(np.float32)
        found = self.scene.compute_closest_points(o3d.core.Tensor(centred))
        positions = found["points"].numpy()
        distance = np.linalg.norm(positions.astype(np.float64) - centred, axis=-1)
        return positions + self.centre, distance, found["primitive_ids"].numpy().astype(np.int64)
