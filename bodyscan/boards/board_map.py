"""Map a flat print into an image (a homography plus a polynomial for the lens), and refine the
corners that it predicts."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Mask
from bodyscan.boards.corners import refine_corners


@dataclass(frozen=True, eq=False)
class BoardMap:
    """Map from printed points (mm) to image points (px): homography plus a polynomial for the lens."""

    homography: Array  # (3, 3)
    coefficients: Array  # (T, 2) px, of the monomials of printed points scaled to about [-1, 1]
    # middle, size: (2,) mm and mm, of that scaling.
    middle: Array
    size: float
    degree: int  # of the polynomial; 0 for none

    def apply(self, printed: Array) -> Array:
        """Map printed points (..., 2) mm to image points (..., 2) px."""
        scaled = (printed - self.middle) / self.size
        return _project(self.homography, printed) + _evaluate_monomials(scaled, self.degree) @ (
            self.coefficients
        )

    def jacobian(self, printed: Array) -> Array:
        """d(pixel)/d(printed) at points (..., 2): (..., 2, 2) px/mm, columns along x and y."""
        step = 1e-3 * self.size
        columns = [
            (self.apply(printed + offset) - self.apply(printed - offset)) / (2 * step)
            for offset in step * np.eye(2)
        ]
        return np.stack(columns, axis=-1)


def fit_board_map(printed: Array, pixels: Array, *, curved: bool = False) -> BoardMap:
    """Fit a map by least squares to printed points (N, 2) mm and their image points (N, 2) px, N >= 4.

    The polynomial is cubic, quadratic or absent, as the number of points allows; a slight ridge
    keeps it from running away where points are few.
    curved: for a fisheye, in whose picture a board may reach from one horizon to the other: a quintic,
        if there are twice as many points as it has terms, and no homography.
    """
    curved = curved and len(printed) >= 42
    middle = (printed.min(axis=0) + printed.max(axis=0)) / 2
    size = float(np.ptp(printed, axis=0).max()) / 2
    homography = np.zeros((3, 3)) if curved else cv2.findHomography(printed, pixels, 0)[0]
    if homography is None:
        homography = np.full((3, 3), np.nan)
    homography[2, 2] = homography[2, 2] or 1.0
    degree = 5 if curved else 3 if len(printed) >= 40 else 2 if len(printed) >= 20 else 0
    design = _evaluate_monomials((printed - middle) / size, degree)
    residual = pixels - _project(homography, printed)
    ridge = (1e-6 if curved else 1e-3) * len(printed) * np.eye(design.shape[1])
    solved = np.linalg.solve(design.T @ design + ridge, design.T @ residual)
    return BoardMap(homography, np.asarray(solved, np.float64), middle, size, degree)


def refine_predicted(
    image: Bytes,
    board_map: BoardMap,
    printed: Array,
    square_mm: float,
    bright_diagonal: Mask,
    *,
    marker_gap: float | None = None,
) -> tuple[Array, Mask]:
    """Refine the corners printed at points (N, 2) mm; return pixels (N, 2) and which are good.

    Corners are looked for where the map predicts them, then where the corners found do, which are
    more accurate than markers. square_mm, bright_diagonal, marker_gap: see `refine_corners`.
    """
    pixels, good = np.zeros_like(printed), np.zeros(len(printed), bool)
    for _ in range(3):
        start, along = board_map.apply(printed), square_mm * board_map.jacobian(printed)
        again, found = refine_corners(image, start, along, bright_diagonal, marker_gap=marker_gap)
        more = found & ~good
        pixels, good = np.where(more[:, None], again, pixels), good | more
        if good.all() or not more.any() or good.sum() < 12:
            break
        board_map = fit_board_map(printed[good], pixels[good])
    return pixels, good


def _project(homography: Array, points: Array) -> Array:
    image = points @ homography[:, :2].T + homography[:, 2]
    return image[..., :2] / image[..., 2:]


def _evaluate_monomials(points: Array, degree: int) -> Array:
    """1, x, y, ... up to x^i y^j with i + j <= degree; for degree 0 a column of zeros."""
    x, y = points[..., 0], points[..., 1]
    if degree == 0:
        return np.zeros_like(points[..., :1])
    terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack(terms, axis=-1)
