"""Estimate the top of the head under hair: fit an ellipsoid to the visible skin, with prior sizes.

Forehead and temples lie on the braincase, which is an ellipsoid to within a few millimetres; what
they leave open is taken from heads in general. Hair only adds on top of the head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import truncnorm

from bodyscan.arrays import Array
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize

AXES_MM = np.array([97.0, 76.0, 97.0])
"""Half the length and breadth of heads (ANSUR II: 195 and 151 mm), and height of the top over brows."""
SKIN = Noise("skin from a braincase", cauchy=2.5, known=1.0)


@dataclass(frozen=True)
class HeadTop:
    """Height of the top of the head above the floor, mm, and its sigma."""

    height_mm: float
    sigma_mm: float


@dataclass(frozen=True, eq=False)
class _Ellipsoid:
    """centre: (3,) mm. size: (4,) log scale of AXES_MM, common to all axes, then per axis."""

    centre: Array
    size: Array

    @property
    def axes(self) -> Array:
        return AXES_MM * np.exp(self.size[0] + self.size[1:])

    @property
    def top_mm(self) -> float:
        return float(self.centre[2] + self.axes[2])

    def distances(self, points: Array) -> tuple[Array, Array]:
        """Distances (N,) mm of points (N, 3) to first order, and by centre and size (N, 7)."""
        scaled = (points - self.centre) / self.axes
        radius = np.linalg.norm(scaled, axis=1)
        slope = scaled / self.axes / radius[:, None]
        steep = np.linalg.norm(slope, axis=1)
        by_axes = -slope * (points - self.centre)
        rows = np.column_stack([-slope, by_axes.sum(axis=1), by_axes]) / steep[:, None]
        return (radius - 1.0) / steep, rows


def estimate_head_top(skin: Array, hair_top_mm: float) -> HeadTop | None:
    """Estimate the top of the head from its skin and the height of its hair.

    skin: points (N, 3) mm in the body frame (x forward, z up).

    None if no skin shows. Under a covered forehead the head ends anywhere between skin and hair.
    """
    if not len(skin):
        return None
    # Brows begin 95 to 125 mm below the top of an adult's head.
    case, low = skin[skin[:, 2] > hair_top_mm - 85.0], float(skin[:, 2].max())
    # One point per cell of 15 mm, a braincase's smallest dents: closer points have correlated errors.
    _, first = np.unique(np.floor(case / 15.0).astype(int), axis=0, return_index=True)
    if len(first) < 12:  # 27 cm2 of skin, half a forehead
        return HeadTop(0.5 * (low + hair_top_mm), float((hair_top_mm - low) / np.sqrt(12.0)))
    solution = _fit(case[first], hair_top_mm)
    by_top = np.zeros(7)
    by_top[2], by_top[3], by_top[6] = 1.0, solution.state.axes[2], solution.state.axes[2]
    sigma = float(np.sqrt(by_top @ solution.covariance @ by_top))
    # A normal distribution, truncated to the range that skin and hair leave open.
    top = solution.state.top_mm
    ends = (low - top) / sigma, (hair_top_mm - top) / sigma
    left = truncnorm(*ends, loc=top, scale=sigma)
    return HeadTop(float(left.mean()), float(left.std()))


def _fit(points: Array, hair_top_mm: float) -> Solution[_Ellipsoid]:
    """Fit an ellipsoid to points of skin (N, 3), with head sizes in general as prior."""
    middle = np.array([points[:, 0].max() - AXES_MM[0], points[:, 1].mean(), 0.0])
    middle[2] = hair_top_mm - AXES_MM[2]
    # Centre (uninformative), common size (children included), and each axis by itself.
    prior = np.concatenate([np.full(3, 100.0), [0.06], np.full(3, 0.04)])

    def blocks(head: _Ellipsoid) -> list[Block]:
        distances, rows = head.distances(points)
        deviation = np.concatenate([head.centre - middle, head.size])
        return [
            # 4 mm: of a braincase from an ellipsoid.
            Block(distances, lambda: rows, slice(0, 7), SKIN, 4.0),
            Block(deviation, lambda: np.eye(7), slice(0, 7), EXACT, prior),
        ]

    def retract(head: _Ellipsoid, step: Array) -> _Ellipsoid:
        return _Ellipsoid(head.centre + step[:3], head.size + step[3:])

    return minimize(_Ellipsoid(middle, np.zeros(4)), blocks, retract, unknowns=7)
