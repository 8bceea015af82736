"""What hides what, against every ray met with every face, and every dot with every other."""

from __future__ import annotations

import numpy as np

from bodyscan.mesh.depth_buffer import find_nearest_faces, find_nearest_points

HEIGHT, WIDTH = 30, 40


def scattered(count: int) -> np.ndarray:
    """Column, row and depth of places in and around the picture."""
    rng = np.random.default_rng(1)
    return (rng.random((count, 3)) * [60.0, 50.0, 9.0] - [10.0, 10.0, -1.0]).astype(np.float32)


def test_the_nearest_of_all_faces_that_hold_a_pixel_is_shown() -> None:
    places = scattered(90)
    places[-1] = np.nan  # its faces cannot be seen
    faces = np.arange(90).reshape(-1, 3)
    number = find_nearest_faces(places, faces, HEIGHT, WIDTH)
    a, b, c = np.moveaxis(places[faces].astype(float), 1, 0)
    nearest = np.full((HEIGHT, WIDTH), -1)
    for r in range(HEIGHT):
        for k in range(WIDTH):
            # Barycentric coordinates by Cramer's rule.
            system = np.stack([b - a, c - a], axis=-1)[:, :2]
            offset = (np.array([k, r]) - a[:, :2])[..., None]
            with np.errstate(invalid="ignore"):
                share = np.linalg.solve(system[:-1], offset[:-1])[..., 0]
                depth = a[:-1, 2] + np.sum(share * np.stack([b - a, c - a], -1)[:-1, 2], axis=1)
            inside = (share >= 0).all(axis=1) & (share.sum(axis=1) <= 1)
            if inside.any():
                nearest[r, k] = np.argmin(np.where(inside, depth, np.inf))
    assert (nearest >= 0).mean() > 0.5
    np.testing.assert_array_equal(number, nearest)


def test_the_nearest_of_all_dots_that_hold_a_pixel_is_shown() -> None:
    places, size = scattered(200), 3
    number = find_nearest_points(places, size, HEIGHT, WIDTH)
    nearest = np.full((HEIGHT, WIDTH), -1)
    for n in np.argsort(-places[:, 2]):  # far to near: the nearest is written last
        column, row = np.floor(places[n, :2] + 0.5).astype(int)
        top, left = max(0, row - 1), max(0, column - 1)
        nearest[top : max(0, row + 2), left : max(0, column + 2)] = n
    assert 0.2 < (nearest >= 0).mean() < 1.0
    np.testing.assert_array_equal(number, nearest)
