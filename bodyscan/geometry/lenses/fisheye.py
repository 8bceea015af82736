"""Kannala and Brandt's lens, OpenCV's fisheye: the angle from the axis mapped by a polynomial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.lens import Lens

NEAR_AXIS = 1e-8
"""Squared radius below which theta / r is its series 1 - r^2 / 3, exact to rounding."""


@dataclass(frozen=True)
class Fisheye(Lens):
    """real = ideal theta_d / r, with theta = atan r and

        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).

    All coefficients 0 is the equidistant lens. Only what lies ahead of the camera is imaged here.

    Source: Kannala and Brandt, A Generic Camera Model and Calibration Method, PAMI 28(8), 2006;
    OpenCV's fisheye, COLMAP's OPENCV_FISHEYE, Kalibr's equidistant.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    kind: ClassVar[str] = "fisheye"

    @property
    def prior_sigmas(self) -> Array:
        return np.array([0.5, 0.5, 0.2, 0.1])

    def distort(self, ideal: Array) -> Array:
        return ideal * self._factor(np.sum(ideal**2, axis=-1))[0][..., None]

    def by_coefficients(self, ideal: Array) -> Array:
        ratio, theta = _angle(np.sum(ideal**2, axis=-1))
        powers = theta[..., None] ** np.array([2, 4, 6, 8])
        return ideal[..., None] * (ratio[..., None] * powers)[..., None, :]

    def by_point(self, ideal: Array) -> Array:
        factor, slope = self._factor(np.sum(ideal**2, axis=-1))
        along = 2.0 * slope[..., None, None] * ideal[..., None] * ideal[..., None, :]
        return along + factor[..., None, None] * np.eye(2)

    def _factor(self, r2: Array) -> tuple[Array, Array]:
        """theta_d / r at squared radii (...), and its derivative by them."""
        ratio, theta = _angle(r2)
        t2 = theta * theta
        factor = 1.0 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4)))
        by_t2 = self.k1 + t2 * (2.0 * self.k2 + t2 * (3.0 * self.k3 + t2 * 4.0 * self.k4))
        # d(theta)/d(r^2) = 1 / (2 r (1 + r^2)), and ratio = theta / r.
        near = r2 < NEAR_AXIS
        safe = np.where(near, 1.0, r2)
        ratio_slope = np.where(near, -1.0 / 3.0, (1.0 / (1.0 + safe) - ratio) / (2.0 * safe))
        t2_slope = ratio / (1.0 + r2)
        return ratio * factor, ratio_slope * factor + ratio * by_t2 * t2_slope


def _angle(r2: Array) -> tuple[Array, Array]:
    """theta / r and theta at squared radii (...)."""
    radius = np.sqrt(r2)
    theta = np.arctan(radius)
    near = r2 < NEAR_AXIS
    return np.where(near, 1.0 - r2 / 3.0, theta / np.where(near, 1.0, radius)), theta
