"""What is interpolated between pixels' corners, against casting every ray."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from small_view import LAMPS, SHARP, projector, view, wall

from bodyscan.arrays import Floats, Mask
from bodyscan.rig.board import Board
from bodyscan.simulation import rays
from bodyscan.simulation.board import board_print
from bodyscan.simulation.rays import ends_of_rays, interpolate, mean_light, min_over_samples
from bodyscan.simulation.render import render_pair
from bodyscan.simulation.scene import Scene, Surface, grid_surface
from bodyscan.simulation.settings import BoardMaking, Projection


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
        printed=board_print(board, 0, BoardMaking()),
        print_xy=places,
    )
    return Scene([wall(1500.0), ball, sheet])


def test_images_are_as_if_every_ray_were_cast(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, light, evens = furnished(), projector(), []
    soft = Projection(blur_stripes=0.25)

    def rendered() -> dict[str, Floats]:
        return render_pair(scene, view(SHARP), light, LAMPS, soft, np.random.default_rng(0))

    quick = rendered()
    judged = rays._mask_smooth

    def none_is_even(*about: object) -> Mask:
        evens.append(judged(*about))  # type: ignore[arg-type]  # handed on as it came
        return np.zeros_like(evens[-1])

    monkeypatch.setattr(rays, "_mask_smooth", none_is_even)
    slow = rendered()
    # pixels are 5 to 8 mm wide here: the ball, of 120 mm, is nowhere flat enough, nor are rims
    assert np.mean(np.concatenate(evens)) > 0.7
    for name, image in slow.items():
        off = np.abs(quick[name] - image)
        # float32; where a print's edge passes a sample closely, that one of nine may fall beyond it
        assert np.percentile(off, 99.5) < 0.05, name
        assert off.max() < 1.1 * 200.0 * (0.8 - 0.06) / 9, name


def test_a_curved_surface_is_cast_ray_by_ray() -> None:
    scene, band = furnished(), view(SHARP).bands[0]
    ends = ends_of_rays(scene, band, projector(), LAMPS)
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


def test_light_of_a_pixel_is_the_mean_over_its_samples() -> None:
    rng = np.random.default_rng(0)
    weight = rng.random((3, 4, 9), dtype=np.float32)
    table = rng.random(50, dtype=np.float32)
    index = rng.integers(0, 50, weight.shape, dtype=np.int32)
    plain = (weight * table[index]).mean(axis=-1)
    assert mean_light(weight, index, table) == pytest.approx(plain, rel=1e-6)
    assert np.array_equal(min_over_samples(weight), weight.min(axis=-1))
