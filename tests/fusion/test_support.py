"""Support of a mesh's vertices by a cloud's points."""

from __future__ import annotations

import numpy as np
import pytest
from made_bodies import cloud_of, ellipsoid

from bodyscan.fusion.support import Support, fit_to_points, measure_support
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.topology import compute_vertex_normals

REACH_MM = 4.0
UP = np.array([0.0, 0.0, 1.0])


def sheet(spacing: float = 1.3) -> np.ndarray:
    """Points of the plane z = 0 with x from -20 mm to 0, a rim."""
    x, y = np.meshgrid(np.arange(-20, 0.1, spacing), np.arange(-20, 20, spacing))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


def asked(cloud: BodyCloud, vertices: list[list[float]]) -> Support:
    """Vertices that look up."""
    places = np.array(vertices, float)
    normals = np.broadcast_to(UP, places.shape).astype(np.float32)
    return measure_support(places, normals, cloud, REACH_MM)


def test_a_vertex_over_a_plane_knows_how_far() -> None:
    found = asked(cloud_of(sheet(), UP), [[-10.0, 0.0, 0.3], [-10.4, 2.0, -0.5], [-8.0, 1.0, 0.0]])
    np.testing.assert_allclose(found.shift_mm, [-0.3, 0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(found.scatter_mm, 0.0, atol=1e-6)
    assert found.measured.all()


@pytest.mark.parametrize(("height", "measured"), [(0.98, True), (1.02, False), (-1.02, False)])
def test_what_is_lifted_off_the_points_is_not_measured(height: float, measured: bool) -> None:
    # A quarter of the reach is the limit.
    assert asked(cloud_of(sheet(), UP), [[-10.0, 0.0, height]]).measured == [measured]


def test_the_surface_ends_a_little_after_the_points() -> None:
    beyond = np.arange(0.0, 5.1, 0.5)
    found = asked(cloud_of(sheet(), UP), [[x, 0.2, 0.0] for x in beyond])
    assert found.measured[beyond <= 2.0].all()
    assert not found.measured[beyond >= 4.0].any()
    assert found.weight[-1] == 0.0
    assert found.shift_mm[-1] == 0.0


def test_between_two_surfaces_that_disagree_nothing_is_measured() -> None:
    """Two toes seen from above end in a gap; the mesh dips into it, near to points of both."""
    left = sheet()
    right = np.array([2.0, 0.0, 2.2]) + left * [-1.0, 1.0, 1.0]
    cloud = cloud_of(np.concatenate([left, right]), UP)
    found = asked(cloud, [[1.0, 0.0, 1.1], [-6.0, 0.0, 0.0], [8.0, 0.0, 2.2]])
    np.testing.assert_array_equal(found.measured, [False, True, True])


def test_noise_that_the_sigmas_know_of_is_no_contradiction() -> None:
    rng = np.random.default_rng(0)
    noisy = sheet(spacing=0.7)
    noisy[:, 2] = rng.normal(0.0, 1.5, len(noisy))
    vertices = np.column_stack([rng.uniform(-15, -5, 300), rng.uniform(-9, 9, 300), np.zeros(300)])
    honest = asked(cloud_of(noisy, UP, sigma_mm=1.5), vertices.tolist())
    assert honest.measured.mean() > 0.99
    assert asked(cloud_of(noisy, UP, sigma_mm=0.05), vertices.tolist()).measured.mean() < 0.3


def test_a_point_that_faces_away_has_no_say_in_the_shift() -> None:
    """The other side of a thin fold: only what faces as the vertex does can be its surface."""
    front, back = sheet(), sheet() - [0.0, 0.0, 2.0]
    normals = np.concatenate([np.tile(UP, (len(front), 1)), np.tile(-UP, (len(back), 1))])
    found = asked(cloud_of(np.concatenate([front, back]), normals), [[-10.0, 0.0, 0.2]])
    assert found.shift_mm[0] == pytest.approx(-0.2, abs=1e-6)


def test_a_surface_settles_on_its_points() -> None:
    vertices, faces = ellipsoid((50.0, 50.0, 50.0), resolution=40)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(60_000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    cloud = cloud_of(50.0 * ways, ways)
    bumpy = vertices * (1.0 + 0.01 * np.sin(vertices[:, :1] / 3.0))
    normals = compute_vertex_normals(bumpy, faces)
    around = measure_support(bumpy, normals, cloud, REACH_MM)
    moved = fit_to_points(bumpy, faces, normals, around)
    off = np.abs(np.linalg.norm(bumpy, axis=1) - 50.0).max()
    assert off > 0.4
    # Tangent planes 1 mm away lie 1 / 100 mm over a ball of 50 mm.
    assert np.abs(np.linalg.norm(moved, axis=1) - 50.0).max() < 0.03


def test_no_face_folds_over() -> None:
    """Slivers are narrower than the moves of their corners."""
    vertices, faces = ellipsoid((50.0, 50.0, 50.0), resolution=40)
    rng = np.random.default_rng(0)
    count = len(vertices)
    normals = compute_vertex_normals(vertices, faces)
    shifts = rng.uniform(-1.0, 1.0, count)
    everywhere = Support(
        np.zeros(count, np.int64),
        np.full(count, 0.1, np.float32),
        np.full(count, 3.0),
        shifts,
        np.zeros(count),
        REACH_MM,
    )
    # Near the poles faces are 0.3 mm wide.
    moved = fit_to_points(vertices, faces, normals, everywhere)

    def cosines(places: np.ndarray) -> np.ndarray:
        before, after = (
            np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]])
            for p in (vertices, places)
        )
        size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        return np.sum(before * after, axis=1) / size

    assert cosines(vertices + shifts[:, None] * normals).min() < 0.3
    assert cosines(moved).min() > 0.3
    assert np.mean(np.abs(moved - vertices - shifts[:, None] * normals).max(axis=1) < 1e-12) > 0.8


def test_shift_and_spread_are_weighted_means_of_the_planes_around() -> None:
    points = np.array([[0.5, 0.0, 0.2], [0.0, 2.0, -0.1], [-1.0, 1.0, 0.4]])
    normals = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.28, 0.96]])
    found = asked(cloud_of(points, normals), [[0.0, 0.0, 0.0]])
    near = np.exp(-0.5 * np.sum(points**2, axis=1) / 2.0**2)
    plane = np.sum(points * normals, axis=1)
    facing = near * normals[:, 2] ** 2
    shift = np.sum(facing * plane) / np.sum(facing)
    assert found.weight[0] == pytest.approx(np.sum(facing), rel=1e-5)
    assert found.shift_mm[0] == pytest.approx(shift, rel=1e-5)
    spread = np.sqrt(np.sum(near * (plane - shift) ** 2) / np.sum(near))
    assert found.scatter_mm[0] == pytest.approx(spread, rel=1e-5)
    assert found.nearest[0] == 0


def told(**values: list[float]) -> Support:
    """Vertices whose weight is 1, and that lie on points of no noise, but for `values`."""
    count = len(next(iter(values.values())))
    given = {"sigma_mm": 0.0, "weight": 1.0, "shift_mm": 0.0, "scatter_mm": 0.0}
    all_ = {name: np.broadcast_to(values.get(name, usual), count) for name, usual in given.items()}
    return Support(np.zeros(count, np.int64), reach_mm=REACH_MM, **all_)


@pytest.mark.parametrize(
    ("shift", "weight", "moved_mm"),
    [(0.8, 3.0, 0.8), (3.0, 3.0, 1.0), (-3.0, 3.0, -1.0), (0.8, 0.5, 0.4), (-3.0, 0.5, -0.5)],
)
def test_a_vertex_moves_by_a_quarter_of_the_reach_at_most_and_less_where_points_end(
    shift: float, weight: float, moved_mm: float
) -> None:
    vertices, faces = ellipsoid((50.0, 50.0, 50.0), resolution=40)
    count = len(vertices)
    around = told(shift_mm=[shift] * count, weight=[weight] * count)
    normals = (vertices / 50.0).astype(np.float32)
    moved = fit_to_points(vertices, faces, normals, around)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 50.0 + moved_mm, atol=1e-4)
