"""How well a calibration is known: joint covariance of the pairs' poses, sigma of pixels' rays."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.geometry.transforms import twist_jacobian


@dataclass(frozen=True, eq=False)
class PoseCovariance:
    """Joint covariance (6P, 6P) of small motions of the pairs `names`, rig frame.

    A motion is a rotation vector (radians) about the rig's origin, then a translation (mm).
    """

    names: tuple[str, ...]
    matrix: Array

    def marginal(self, name: str) -> Array:
        """Covariance (6, 6) of one pair's motion."""
        return self.select([name])

    def select(self, names: Sequence[str]) -> Array:
        """Covariance (6N, 6N) of these pairs' motions, in their order."""
        rows = self._rows(names)
        return self.matrix[np.ix_(rows, rows)]

    def relative(self, a: str, b: str) -> Array:
        """Covariance (6, 6) of the motion of b relative to a."""
        difference = np.concatenate([-np.eye(6), np.eye(6)], axis=1)
        return difference @ self.select([a, b]) @ difference.T

    def add_motions(
        self, names: Collection[str], covariance: Array, *, common: bool
    ) -> PoseCovariance:
        """Add a motion of covariance (6, 6) to these pairs: independent ones, or a `common` one, such
        as a pole's, which leaves their covariance relative to each other unchanged."""
        rows, matrix, count = self._rows(names), self.matrix.copy(), len(names)
        correlation = np.ones((count, count)) if common else np.eye(count)
        matrix[np.ix_(rows, rows)] += np.kron(correlation, covariance)
        return PoseCovariance(self.names, matrix)

    def _rows(self, names: Collection[str]) -> Indices:
        first = np.array([6 * self.names.index(name) for name in names], int)
        return (first[:, None] + np.arange(6)).ravel()


def point_covariance(motion_covariance: Array, point: Array) -> Array:
    """Covariance (3, 3) mm^2 of a rig point (3,) due to a motion with covariance (6, 6)."""
    jacobian = twist_jacobian(point[None])[0]
    return jacobian @ motion_covariance @ jacobian.T


def compute_position_sigma(covariance: PoseCovariance, name: str, position: Array) -> Array:
    """Standard deviations (3,) mm, along the rig's axes, of a point attached to the pair.

    position: (3,) mm, rig frame, such as the centre of the pair's camera.
    """
    return np.sqrt(np.diag(point_covariance(covariance.marginal(name), position)))


ROWS, COLUMNS = 17, 21
"""Nodes across an image; the uncertainty is smooth between them."""


@dataclass(frozen=True, eq=False)
class RayUncertainty:
    """Standard deviations of a coordinate, px, at ROWS x COLUMNS nodes from first to last pixel."""

    noise_px: Array  # due to the corners' noise
    lens_px: Array  # due to the choice of lens model

    @property
    def sigma_px(self) -> Array:
        """Both combined, (ROWS, COLUMNS)."""
        return np.hypot(self.noise_px, self.lens_px)

    def inflate_noise(self, variances: float) -> RayUncertainty:
        """The same with the noise that many times larger, in variances."""
        return replace(self, noise_px=np.sqrt(variances) * self.noise_px)

    def image(self, width: int, height: int) -> Floats:
        """sigma_px (height, width) of every pixel, linear between nodes."""
        v = np.linspace(0.0, ROWS - 1.0, height, dtype=np.float32)
        u = np.linspace(0.0, COLUMNS - 1.0, width, dtype=np.float32)
        return cv2.remap(self.sigma_px.astype(np.float32), *np.meshgrid(u, v), cv2.INTER_LINEAR)


def list_node_pixels(width: int, height: int) -> Array:
    """Pixels (ROWS, COLUMNS, 2) of the nodes."""
    u, v = np.linspace(0.0, width - 1.0, COLUMNS), np.linspace(0.0, height - 1.0, ROWS)
    return np.stack(np.meshgrid(u, v), axis=-1)
