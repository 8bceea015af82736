"""Open3D's ray-casting scene of a mesh: nearest points, rays that hit it."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Indices


def centred_scene(vertices: Array, faces: Indices) -> tuple[o3d.t.geometry.RaycastingScene, Array]:
    """A scene of vertices (V, 3) less their mean, because it
    computes in float32; and that mean (3,)."""
    centre = vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor((vertices - centre).astype(np.float32)),
        o3d.core.Tensor(faces.astype(np.uint32)),
    )
    return scene, centre
