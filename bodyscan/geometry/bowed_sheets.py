"""Sheets that vary smoothly with s and may bow across their width; without bow, smooth planes.

In a frame roughly at the projector let y' = Y/Z across the stripes, x' = (X + x0)/Z along them and
w = D/Z - 1. The sheet at s is

    y' = p(s) + q(s) x' + r(s) w + b2(s) x'^2 + b3(s) x'^3 + ...

Without the b terms this can represent any plane; p, q, r, b are Chebyshev polynomials over [0, S].
The projector's centre is not assumed to be known: r(s) moves each sheet independently. Only the
bow, which is small, is extended radially from the frame's origin, shifted along the stripes by x0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev

from bodyscan.arrays import Array
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.smooth_sheets import Offset, SmoothSheets

PLANE_DEGREE, BOW_DEGREE = 7, 3
FALL = 0.3
PLANE_SPREAD = (1.0, 0.03, 0.03)
BOW_SPREAD = (0.1, 0.03, 0.03)
"""Standard deviations, before any data, of p, q, r and of b2, b3, ...: coefficient m of a
polynomial is expected to be FALL times as large as coefficient m - 1."""
ASIDE = 0.3
"""Standard deviation of the boards' middle along the stripes, as a share of its distance."""


@dataclass(frozen=True, eq=False)
class SheetsAtStripe:
    """Coefficients (..., K) at s, their derivatives by s, and the Chebyshev polynomials (...,
    M)."""

    value: Array
    slope: Array
    basis: Array


@dataclass(frozen=True, eq=False)
class BowedSheets(SmoothSheets):
    """Smooth planes, or sheets with a bow of `bow_terms` terms.

    parameters: coefficients of p, q, r (PLANE_DEGREE), then of b2, b3, ... (BOW_DEGREE), lowest
    degree
        first; with a bow, x0 (mm) is the last.
    bow_terms: number of terms b2, b3, ...; 0 for planes.
    """

    bow_terms: int

    @staticmethod
    def from_pinhole(pinhole: LensSheets, bow_terms: int) -> BowedSheets:
        """The planes of a projector without a lens, y' = (s - c) / f: the start of a fit."""
        size = 3 * (PLANE_DEGREE + 1) + bow_terms * (BOW_DEGREE + 1) + (bow_terms > 0)
        parameters, half = np.zeros(size), pinhole.stripes / 2.0
        focal, centre = pinhole.parameters[:2]
        parameters[:2] = (half - centre) / focal, half / focal
        return BowedSheets(
            pinhole.projector_from_camera,
            pinhole.middle,
            pinhole.stripes,
            pinhole.direction,
            parameters,
            np.full((size, size), np.nan),
            bow_terms,
        )

    @property
    def kind(self) -> str:
        return "bowed" if self.bow_terms else "smooth-planes"

    def prior(self) -> tuple[Array, Array]:
        fall = FALL ** np.arange(PLANE_DEGREE + 1)
        # A lens bows the sheets above and below its axis in opposite directions: b2 grows with s.
        late = FALL ** np.maximum(np.arange(BOW_DEGREE + 1) - 1, 0)
        spread = [size * fall for size in PLANE_SPREAD]
        spread += [size * late for size in BOW_SPREAD[: self.bow_terms]]
        deviation = self.parameters
        if self.bow_terms:
            spread.append(np.array([ASIDE * self.distance_mm]))
            middle = self.projector_from_camera.apply(self.middle)[0]
            deviation = np.append(deviation[:-1], middle + deviation[-1])
        size = np.concatenate(spread)
        return deviation / size, np.diag(1.0 / size)

    def retract(self, step: Array) -> BowedSheets:
        return replace(self, parameters=self.parameters + step)

    def at(self, s: Array) -> SheetsAtStripe:
        u = 2.0 * np.asarray(s, float) / self.stripes - 1.0
        basis: Array = chebyshev.chebvander(u, PLANE_DEGREE).astype(np.float64)
        polynomials = self._polynomials()
        slopes = chebyshev.chebder(polynomials, axis=1) * (2.0 / self.stripes)
        return SheetsAtStripe(basis @ polynomials.T, basis[..., :-1] @ slopes.T, basis)

    def offset(self, points: Array, sheet: SheetsAtStripe, *, parameters: bool = False) -> Offset:
        seen = self.projector_from_camera.apply(points)
        reach = seen[..., 2]
        shift = self.parameters[-1] if self.bow_terms else 0.0
        x, y, w = (seen[..., 0] + shift) / reach, seen[..., 1] / reach, self.distance_mm / reach
        powers = [np.ones_like(x), x]
        for _ in range(self.bow_terms):
            powers.append(powers[-1] * x)
        terms = np.stack([powers[0], x, w - 1.0, *powers[2:]], axis=-1)
        by_x = -sheet.value[..., 1]
        for n in range(2, 2 + self.bow_terms):
            by_x = by_x - n * sheet.value[..., 1 + n] * powers[n - 1]
        by_z = -by_x * x - y + sheet.value[..., 2] * w
        by_point = np.stack([by_x, np.ones_like(x), by_z], axis=-1) / reach[..., None]
        return Offset(
            y - np.sum(sheet.value * terms, axis=-1),
            by_point @ self.projector_from_camera.rotation,
            -np.sum(sheet.slope * terms, axis=-1),
            reach,
            self._by_parameter(sheet.basis, terms, by_point) if parameters else None,
        )

    def _by_parameter(self, basis: Array, terms: Array, by_point: Array) -> Array:
        columns = [-terms[..., k, None] * basis for k in range(3)]
        low = basis[..., : BOW_DEGREE + 1]
        columns += [-terms[..., 3 + k, None] * low for k in range(self.bow_terms)]
        columns += [by_point[..., :1]] if self.bow_terms else []
        return np.concatenate(columns, axis=-1)

    def _polynomials(self) -> Array:
        """Coefficients (3 + bow_terms, PLANE_DEGREE + 1), one row per polynomial."""
        planes = 3 * (PLANE_DEGREE + 1)
        rows = np.zeros((3 + self.bow_terms, PLANE_DEGREE + 1))
        rows[:3] = self.parameters[:planes].reshape(3, -1)
        if self.bow_terms:
            rows[3:, : BOW_DEGREE + 1] = self.parameters[planes:-1].reshape(self.bow_terms, -1)
        return rows
