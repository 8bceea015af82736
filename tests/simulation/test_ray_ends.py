"""What is interpolated between pixels' corners, against casting every ray."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from small_view import LAMPS, SHARP, projector, view, wall

from bodyscan.rig.board import Board
from bodyscan.simulation.board import make_print
from bodyscan.simulation.rays import interpolate, trace_band
from bodyscan.simulation.scene import Scene, Surface, grid_surface
from bodyscan.simulation.settings import BoardMaking


def furnished() -> Scene:
    """A wall, a ball that throws a shadow on it, a slanting board."""
    mesh = o3d.geometry.TriangleMesh.create_sphere(120.0, resolution=200)
    mesh.compute_vertex_normals()
    ball = Surface(
        np.asarray(mesh.vertices) + [-150.0, -40.0, 1000.0],
        np.asarray(mesh.triangles),
        0.8,
        normals=np.asarray(mesh.vertex_normals),
    )
    board = Board(name="plain", kind="checkerboard", columns=6, rows=5, square_mm=50.0)
    places = np.array([[0, 0], [300, 0], [0, 250], [300, 250]], float)
    corner, down = np.array([20.0, -150, 900]), np.array([0, 250.0, 0])
    slanting = grid_surface(corner, np.array([280.0, 0, 110]), down)
    sheet = Surface(
        slanting.vertices,
        slanting.triangles,
        printed=make_print(board, 0, BoardMaking()).albedo,
        print_xy=places,
    )
    return Scene([wall(1500.0), ball, sheet])


def test_a_curved_surface_is_cast_ray_by_ray() -> None:
    scene, band = furnished(), view(SHARP).bands[0]
    ends = trace_band(scene, band, projector(), LAMPS)
    straight = scene.cast(band.rays.reshape(-1, 3)).depth.reshape(ends.depth.shape)
    assert ends.depth == pytest.approx(straight, abs=0.01)


def test_interpolation_is_bilinear() -> None:
    rng = np.random.default_rng(0)
    corners = rng.random((2, 4, 5), dtype=np.float32)
    shift = rng.random((3, 4, 2), dtype=np.float32)
    offsets = rng.random((6, 2), dtype=np.float32)
    even = rng.random((3, 4)) < 0.7
    values = np.full((2, 3, 4, 6), -1.0, np.float32)
    interpolate(corners, shift, offsets, even, values)
    x, y = np.moveaxis((offsets + shift[:, :, None]) % 1.0, -1, 0)
    a, b, c, d = (
        corners[:, r : r + 3, k : k + 4, None] for r, k in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    plain = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
    assert values[:, even] == pytest.approx(plain[:, even], abs=1e-6)
    assert (values[:, ~even] == -1.0).all()
