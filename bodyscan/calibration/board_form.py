"""The form of a board: a face as found, and the unknowns of bend and print.

The sheet departs from its plane by a polynomial of second and third degree, and its corners are
printed slightly off their places: each by itself, and all together where a printer's feed or
carriage errs slowly over the sheet. All have priors, so whatever boards in few poses cannot show
stays as uncertain as it was, and enters every covariance. Of a print that is its stretch and its
skew: a camera of another aspect or skew sees the same corners.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from bodyscan.arrays import Array, Indices

# Powers of x and y, in the order of `_powers`.
POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
THIRD_DEGREE = np.add.outer(np.arange(4), np.arange(4)) <= 3
FALL = 0.3
"""Expected size of each degree relative to the one below: what bends a sheet, and what errs slowly
while it is printed, does so over lengths beyond the sheet's own."""
SLOW = ((1, 0), (0, 1), *POWERS)
"""Powers of x and y by which a print is distorted."""
DIGITS = 6
LEAST_MM = 1e-6
"""Standard deviation of what is described as exact: a nanometre."""


@dataclass(frozen=True, eq=False)
class BoardFace:
    """The sheet on which the corners of one face lie, board frame.

    Above the plane z = z_mm it is a polynomial of third degree in x and y, scaled so that `middle`
    (2,) mm becomes 0 and `half` (2,) mm from it becomes 1; coefficients: (4, 4) mm.
    """

    z_mm: float
    middle: Array
    half: Array
    coefficients: Array

    @staticmethod
    def through(points: Array) -> BoardFace:
        """The face nearest to corners (N, 3) mm, board frame."""
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-9)
        z_mm, (x, y) = float(np.median(points[:, 2])), ((points[:, :2] - middle) / half).T
        powers = np.polynomial.polynomial.polyvander2d(x, y, (3, 3)) * THIRD_DEGREE.ravel()
        found = np.linalg.lstsq(powers, points[:, 2] - z_mm, rcond=1e-9)[0]
        return BoardFace(z_mm, middle, half, found.reshape(4, 4))

    def height(self, places: Array) -> Array:
        """Heights (...) mm above the plane at places (..., 2) mm of the board."""
        x, y = np.moveaxis((places - self.middle) / self.half, -1, 0)
        return np.asarray(np.polynomial.polynomial.polyval2d(x, y, self.coefficients))


def rounded(points: Array) -> Array:
    """Corners (..., 3) mm as they are told apart, without a -0."""
    return np.round(points, DIGITS) + 0.0


@dataclass(frozen=True)
class PrintSpread:
    """Standard deviations of where corners are printed, along each axis, mm.

    corner_mm: of each corner by itself.
    stretch_mm: of what they share by one stretch or skew, RMS over the corners; that of higher
        degrees follows from it (FALL).
    """

    corner_mm: float
    stretch_mm: float = 0.0


EXACT_PRINT = PrintSpread(0.0)


@dataclass(frozen=True, eq=False)
class BoardForm:
    """The form of a board as unknowns.

    points: corners as the board is described, (N, 3) mm.
    heights: coefficients of POWERS, each less its own best plane, (7,) mm; x and y are -1 and 1 at
        the outermost corners.
    printed: how far corners lie from `points` in the sheet, (N, 2) mm.
    flatness_mm, print_spread: prior standard deviations of heights and printed.
    """

    points: Array
    heights: Array
    printed: Array
    flatness_mm: float
    print_spread: PrintSpread

    @staticmethod
    def flat(points: Array, flatness_mm: float, print_spread: PrintSpread) -> BoardForm:
        """A board as described; points (M, 3) are the corners of any views given."""
        known = np.unique(rounded(points), axis=0)
        return BoardForm(
            known, np.zeros(len(POWERS)), np.zeros((len(known), 2)), flatness_mm, print_spread
        )

    @property
    def count(self) -> int:
        """Number of unknowns: heights, then the corners' x and y."""
        return len(self.heights) + self.printed.size

    @property
    def prior(self) -> tuple[Array, Array]:
        """Residuals of the prior, (count,), and their derivatives by the unknowns, (count, count)."""
        bent = [self.flatness_mm * (1.0 if sum(power) == 2 else FALL) for power in POWERS]
        jacobian = block_diag(np.diag(1.0 / np.maximum(bent, LEAST_MM)), self.print_whitening)
        return jacobian @ self.unknowns, jacobian

    @property
    def print_whitening(self) -> Array:
        """(2N, 2N) by which `printed`, row by row, becomes unit normal."""
        spread, slow = self.print_spread, self.slow
        covariance = spread.stretch_mm**2 * slow @ slow.T
        covariance += max(spread.corner_mm, LEAST_MM) ** 2 * np.eye(len(slow))
        root = np.linalg.cholesky(covariance)
        root = solve_triangular(root, np.eye(len(slow)), lower=True)
        return np.asarray(np.kron(root, np.eye(2)), np.float64)

    @property
    def slow(self) -> Array:
        """(N, 9): orthogonal polynomials SLOW at the corners, 1 RMS for degree one and FALL of it
        for each degree more."""
        x, y = ((self.points[:, :2] - self._middle) / self._half).T
        powers = [np.ones_like(x), *(x**i * y**j for i, j in SLOW)]
        modes = np.linalg.qr(np.stack(powers, axis=1))[0][:, 1:]
        fall = FALL ** (np.sum(SLOW, axis=1) - 1.0)
        return np.asarray(modes * np.sqrt(len(x)) * fall[: modes.shape[1]])

    @property
    def exact(self) -> BoardForm:
        """The same form, taken to be exact."""
        return replace(self, flatness_mm=0.0, print_spread=EXACT_PRINT)

    @property
    def unknowns(self) -> Array:
        """Values of the unknowns, (count,) mm."""
        return np.concatenate([self.heights, self.printed.ravel()])

    @property
    def out_of_plane_mm(self) -> float:
        """Height from the lowest to the highest corner, mm."""
        return float(np.ptp(self.basis(self.points[:, :2]) @ self.heights))

    def moved(self, step: Array) -> BoardForm:
        """The form with a step (count,) added to its unknowns."""
        bent, printed = step[: len(POWERS)], step[len(POWERS) :]
        return replace(
            self, heights=self.heights + bent, printed=self.printed + printed.reshape(-1, 2)
        )

    def basis(self, places: Array) -> Array:
        """(..., 7): height at places (..., 2) mm of the board per unit of each of `heights`."""
        powers, plane = self._powers(places)
        return np.asarray(powers - plane @ self._planes, np.float64)

    def height(self, places: Array) -> Array:
        """Heights (...) mm above the plane at places (..., 2) mm of the board."""
        powers, plane = self._powers(places)
        return np.asarray(powers @ self.heights - plane @ (self._planes @ self.heights), np.float64)

    def numbers(self, points: Array) -> Indices:
        """Indices (M,) of corners (M, 3) in `points`."""
        place = {key: k for k, key in enumerate(map(tuple, self.points.tolist()))}
        return np.array([place[key] for key in map(tuple, rounded(points).tolist())], np.int64)

    def applied(self, points: Array, numbers: Indices) -> Array:
        """Where corners (M, 3) lie that are described as `points`."""
        return np.column_stack(
            [points[:, :2] + self.printed[numbers], points[:, 2] + self.height(points[:, :2])]
        )

    @cached_property
    def _middle(self) -> Array:
        return np.asarray((self.points.min(axis=0) + self.points.max(axis=0))[:2] / 2.0)

    @cached_property
    def _half(self) -> Array:
        return np.asarray(np.ptp(self.points, axis=0)[:2] / 2.0)

    @cached_property
    def _planes(self) -> Array:
        """(3, 7): the best plane of each power at the corners."""
        powers, plane = self._powers(self.points[:, :2])
        return np.asarray(np.linalg.lstsq(plane, powers, rcond=None)[0])

    def _powers(self, places: Array) -> tuple[Array, Array]:
        """POWERS (..., 7) and 1, x, y (..., 3) of places (..., 2) mm."""
        x, y = np.moveaxis((places - self._middle) / self._half, -1, 0)
        xx, yy = x * x, y * y
        powers = np.stack([xx, x * y, yy, xx * x, xx * y, x * yy, yy * y], axis=-1)
        return powers, np.stack([np.ones_like(x), x, y], axis=-1)
