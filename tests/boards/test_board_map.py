"""Where a print appears in an image: a homography and a gentle lens, as many terms as points bear."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.boards.board_map import fit_board_map

TRUE = np.array([[2.2, -0.3, 140.0], [0.25, 2.1, 130.0], [4e-4, -3e-4, 1.0]])


def printed(columns: int, rows: int) -> np.ndarray:
    x, y = np.meshgrid(30.0 * np.arange(1, columns + 1), 30.0 * np.arange(1, rows + 1))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def shown(points: np.ndarray, bend: float = 0.0) -> np.ndarray:
    there = np.column_stack([points, np.ones(len(points))]) @ TRUE.T
    pixels = there[:, :2] / there[:, 2:]
    off = (pixels - [400.0, 300.0]) / 300.0
    return np.asarray(pixels + bend * off * np.sum(off**2, axis=1)[:, None])


@pytest.mark.parametrize(
    ("size", "degree", "terms"),
    [((8, 5), 3, 10), ((13, 3), 2, 6), ((5, 4), 2, 6), ((19, 1), 0, 1)],
)
def test_terms_follow_the_number_of_points(size: tuple[int, int], degree: int, terms: int) -> None:
    found = fit_board_map(printed(*size), shown(printed(*size)))
    assert found.degree == degree
    assert found.coefficients.shape == (terms, 2), "those of x and y together up to the degree"


def test_without_a_lens_it_is_the_homography_and_its_slopes() -> None:
    points = printed(9, 6)
    found = fit_board_map(points, shown(points))
    place = np.array([[33.0, 71.0], [200.0, 155.0]])
    np.testing.assert_allclose(found.apply(place), shown(place), atol=1e-6)
    for k, step in enumerate(np.eye(2)):
        slope = (shown(place + 1e-3 * step) - shown(place - 1e-3 * step)) / 2e-3
        np.testing.assert_allclose(found.jacobian(place)[..., k], slope, rtol=1e-5)
    np.testing.assert_allclose(found.middle, [150.0, 105.0])
    assert found.size == 120.0


def test_a_gentle_lens_is_followed_where_points_are_many() -> None:
    points = printed(9, 6)
    found = fit_board_map(points, shown(points, 3.0))
    off = found.apply(points) - shown(points, 3.0)
    # Three pixels at 300 from the middle: a homography alone is off by half of one.
    assert np.sqrt(np.mean(off**2)) < 0.05
    few = printed(3, 3)
    off = fit_board_map(few, shown(few, 30.0)).apply(few) - shown(few, 30.0)
    assert np.sqrt(np.mean(off**2)) > 0.05, "nine points leave a lens open"
