"""The nearest points by columns are those that a tree of all points finds."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from bodyscan.fusion.support import PointColumns


def test_the_same_as_a_tree() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-30.0, -40.0, 0.0], [30.0, 40.0, 90.0], (20_000, 3))
    places = rng.uniform([-50.0, -60.0, -20.0], [50.0, 60.0, 110.0], (3000, 3))
    for reach in (2.0, 7.5):
        found = PointColumns.from_points(points, reach).find_nearest(places, 8)
        wanted = cKDTree(points).query(places, 8, distance_upper_bound=reach)
        np.testing.assert_allclose(found[0], wanted[0], rtol=1e-12)
        np.testing.assert_array_equal(found[1], wanted[1])
        assert np.isinf(found[0]).any()


def test_points_in_one_place() -> None:
    points = np.zeros((5, 3))
    distance, near = PointColumns.from_points(points, 4.0).find_nearest(
        np.array([[1.0, 0.0, 0.0]]), 8
    )
    np.testing.assert_array_equal(distance[0], [1.0] * 5 + [np.inf] * 3)
    np.testing.assert_array_equal(near[0], [0, 1, 2, 3, 4, 5, 5, 5])
