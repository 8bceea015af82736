"""Map a flat print into an image: a homography plus a polynomial for the lens."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array


@dataclass(frozen=True, eq=False)
class BoardMap:
    """Map from printed points (mm) to image points (px): homography plus a polynomial for the lens.

    homography: (3, 3).
    coefficients: (T, 2) px, of the monomials of printed points scaled to about [-1, 1].
    middle, size: (2,) mm and mm, of that scaling.
    degree: of the polynomial; 0 for none.
    """

    homography: Array
    coefficients: Array
    middle: Array
    size: float
    degree: int

    def apply(self, printed: Array) -> Array:
        """Map printed points (..., 2) mm to image points (..., 2) px."""
        scaled = (printed - self.middle) / self.size
        return _project(self.homography, printed) + _monomials(scaled, self.degree) @ (
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


def fit_board_map(printed: Array, pixels: Array) -> BoardMap:
    """Fit a map by least squares to printed points (N, 2) mm and their image points (N, 2) px, N >= 4.

    The polynomial is cubic, quadratic or absent, as the number of points allows; a slight ridge
    keeps it from running away where points are few.
    """
    middle = (printed.min(axis=0) + printed.max(axis=0)) / 2
    size = float(np.ptp(printed, axis=0).max()) / 2
    homography = cv2.findHomography(printed, pixels, 0)[0]
    if homography is None:
        homography = np.full((3, 3), np.nan)
    degree = 3 if len(printed) >= 40 else 2 if len(printed) >= 20 else 0
    design = _monomials((printed - middle) / size, degree)
    residual = pixels - _project(homography, printed)
    ridge = 1e-3 * len(printed) * np.eye(design.shape[1])
    solved = np.linalg.solve(design.T @ design + ridge, design.T @ residual)
    return BoardMap(homography, np.asarray(solved, np.float64), middle, size, degree)


def _project(homography: Array, points: Array) -> Array:
    image = points @ homography[:, :2].T + homography[:, 2]
    return image[..., :2] / image[..., 2:]


def _monomials(points: Array, degree: int) -> Array:
    """1, x, y, ... up to x^i y^j with i + j <= degree; for degree 0 a column of zeros."""
    x, y = points[..., 0], points[..., 1]
    if degree == 0:
        return np.zeros_like(points[..., :1])
    terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack(terms, axis=-1)
