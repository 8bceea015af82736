"""Linear Gaussian systems: normal equations that can be summed, projected, reduced and solved.

A quadratic log likelihood of unknowns x, in information form:

    log p(data | x) = const - x^T H x / 2 + b^T x,    mode x = H^-1 b,  covariance H^-1

Unknowns differ in unit (px, radians, mm, stripes), so matrices are scaled to a unit diagonal before
they are solved or inverted. Otherwise a covariance in mm and one in radians differ by so many powers
of ten that the smaller is lost.

Sources: Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, 6.1 (Schur complement);
MacKay, Bayesian Interpolation, Neural Computation 4, 1992 (evidence).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices


@dataclass(frozen=True, eq=False)
class LinearGaussianSystem:
    """Information matrix H and information vector b of P unknowns, or a stack of such systems.

    For residuals r(x) = r0 + J x with weights W (inverse variances), H = J^T W J and
    b = -J^T W r0. A stack (N, P, P) holds N systems of separate unknowns.
    """

    information: Array  # (..., P, P), symmetric, in inverse squared units of the unknowns
    vector: Array  # (..., P)

    @staticmethod
    def from_observations(jacobian: Array, observed: Array, weights: Array) -> LinearGaussianSystem:
        """The system of observations y = J x + noise: H = J^T W J, b = J^T W y.

        jacobian: (..., N, P). observed, weights: (..., N).
        """
        weighted = jacobian * weights[..., None]
        vector = (np.swapaxes(weighted, -1, -2) @ observed[..., None])[..., 0]
        return LinearGaussianSystem(np.swapaxes(jacobian, -1, -2) @ weighted, vector)

    @staticmethod
    def from_prior(information: Array) -> LinearGaussianSystem:
        """A prior x ~ N(0, information^-1)."""
        return LinearGaussianSystem(information, np.zeros(information.shape[:-1]))

    @staticmethod
    def assemble(
        parts: Iterable[tuple[Indices, LinearGaussianSystem]], size: int
    ) -> LinearGaussianSystem:
        """Sum systems of subsets of `size` unknowns.

        parts: the indices (C,) of each system's unknowns, without repetition, and the system.
        """
        information, vector = np.zeros((size, size)), np.zeros(size)
        for columns, system in parts:
            information[np.ix_(columns, columns)] += system.information
            vector[columns] += system.vector
        return LinearGaussianSystem(information, vector)

    @property
    def size(self) -> int:
        """Number of unknowns P (of each system of a stack)."""
        return self.vector.shape[-1]

    def __add__(self, other: LinearGaussianSystem) -> LinearGaussianSystem:
        """Combine independent observations of the same unknowns."""
        information = self.information + other.information
        return LinearGaussianSystem(information, self.vector + other.vector)

    def __mul__(self, weight: Array | float) -> LinearGaussianSystem:
        """Multiply the weight of all observations, for a stack by a factor (...) each."""
        factor = np.asarray(weight)
        information = self.information * factor[..., None, None]
        return LinearGaussianSystem(information, self.vector * factor[..., None])

    def project(self, basis: Array) -> LinearGaussianSystem:
        """The system of z where x = B z: B^T H B, B^T b.

        basis: (P, M). For a stack (..., P, M): z is shared, so its systems are summed.
        """
        flat = basis.reshape(-1, basis.shape[-1])
        product = (self.information @ basis).reshape(flat.shape)
        return LinearGaussianSystem(flat.T @ product, flat.T @ self.vector.ravel())

    def inflate(self, variance: float, columns: slice = slice(None)) -> LinearGaussianSystem:
        """Add a model error of that variance, common to all observations of a system.

        columns: unknowns of the error's kind, such as a shift along unit normals n, for which
            w = tr H[columns, columns] = sum of the weights is the inverse variance of the mean.

        The mean's variance becomes 1/w + variance, so both arrays are divided by 1 + variance w.
        """
        diagonal = np.einsum("...ii->...i", self.information)[..., columns]
        return self * (1.0 / (1.0 + variance * diagonal.sum(axis=-1)))

    def select(self, columns: Indices) -> LinearGaussianSystem:
        """The system of the unknowns `columns` if all others are known to be 0."""
        information = self.information[..., columns[:, None], columns]
        return LinearGaussianSystem(information, self.vector[..., columns])

    def marginalize(self, columns: Indices) -> LinearGaussianSystem:
        """Eliminate the unknowns `columns` (Schur complement); the others stay in their order.

        With a the remaining and e the eliminated unknowns: H_aa - H_ae H_ee^-1 H_ea,
        b_a - H_ae H_ee^-1 b_e.
        """
        rest = np.setdiff1d(np.arange(self.size), columns)
        kept, eliminated = self.select(rest), self.select(columns)
        cross = self.information[..., rest[:, None], columns]
        gain = cross @ invert_scaled(eliminated.information)
        information = kept.information - gain @ np.swapaxes(cross, -1, -2)
        vector = kept.vector - (gain @ eliminated.vector[..., None])[..., 0]
        return LinearGaussianSystem(information, vector)

    def solve(self, damping: Array | float = 0.0) -> Array:
        """The mode H^-1 b, (..., P); damping as in `solve_scaled`."""
        return solve_scaled(self.information, self.vector, damping)

    def covariance(self) -> Array:
        """H^-1, (..., P, P), as in `invert_scaled`."""
        return invert_scaled(self.information)

    def log_evidence(self, prior_variance: Array | float) -> Array:
        """Log marginal likelihood under the prior x ~ N(0, v I), relative to x = 0.

        prior_variance: v, one or several (S,). Returns the same shape:
        b^T (H + I/v)^-1 b / 2 - log det(I + v H) / 2.

        A prior with another covariance R R^T is `project(R)` under v = 1.
        """
        eigenvalues, eigenvectors = np.linalg.eigh(self.information)
        variance = np.asarray(prior_variance, float)[..., None]
        posterior = np.maximum(eigenvalues, 0.0) + 1.0 / variance
        explained = np.sum((self.vector @ eigenvectors) ** 2 / posterior, axis=-1)
        return np.asarray(0.5 * (explained - np.sum(np.log(posterior * variance), axis=-1)))


def solve_scaled(matrix: Array, right: Array, damping: Array | float = 0.0) -> Array:
    """Solve matrix x = right for one symmetric system or many.

    matrix: (..., P, P).
    right: (..., P).
    damping: (...), added to the scaled diagonal (Marquardt).

    A singular system gives the shortest scaled solution.
    """
    size = _take_root_of_diagonal(matrix)
    scaled = matrix / (size[..., :, None] * size[..., None, :])
    diagonal = np.einsum("...ii->...i", scaled)
    diagonal += np.asarray(damping)[..., None]
    columns = (right / size)[..., None]
    try:
        solution = np.linalg.solve(scaled, columns)
    except np.linalg.LinAlgError:
        solution = _invert_pseudo(scaled) @ columns
    return np.asarray(solution[..., 0] / size, np.float64)


def invert_scaled(matrix: Array) -> Array:
    """Pseudo-inverse (..., P, P) of symmetric matrices (..., P, P); NaN for those not finite.

    Directions of a scaled matrix with less than 1e-14 of the largest eigenvalue get no variance.
    """
    size = _take_root_of_diagonal(matrix)
    outer = size[..., :, None] * size[..., None, :]
    scaled = matrix / outer
    try:
        factor = np.linalg.cholesky(scaled)
        regular = bool(np.einsum("...ii->...i", factor).min(initial=1.0) ** 2 > 1e-14)
    except np.linalg.LinAlgError:
        regular = False
    # Eigenvalues take ten times as long and are needed only where the rank is in doubt.
    inverse = np.linalg.inv(scaled) if regular else _invert_pseudo(scaled)
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, -1, -2)) / outer, np.float64)


def _invert_pseudo(scaled: Array) -> Array:
    finite = np.isfinite(scaled).all(axis=(-2, -1))
    inverse = np.full(scaled.shape, np.nan)
    inverse[finite] = np.linalg.pinv(scaled[finite], 1e-14, hermitian=True)
    return inverse


def multiply_transposed(left: Array, right: Array) -> Array:
    """left.T @ right for tall matrices, in blocks of rows too small for BLAS to start threads:
    pairs are fitted in parallel, and threads waiting for a core cost more than they save."""
    block = 128
    blocks = len(left) // block
    if not blocks:
        return np.asarray(left.T @ right, np.float64)
    cut = blocks * block
    head, tail = (matrix[:cut].reshape(blocks, block, -1) for matrix in (left, right))
    return np.sum(head.transpose(0, 2, 1) @ tail, axis=0) + left[cut:].T @ right[cut:]


def _take_root_of_diagonal(matrix: Array) -> Array:
    """Square roots (..., P) of the diagonal; tiny but positive for an unknown without influence."""
    return np.sqrt(np.maximum(np.einsum("...ii->...i", matrix), 1e-300))
