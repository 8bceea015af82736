"""Where the head ends under hair: an ellipsoid through the skin that shows, as heads are made.

Forehead and temples lie on the braincase, which is an ellipsoid within a few millimetres; what they
leave open of it is known of heads in general. Hair is on top of the head, never below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import truncnorm

from bodyscan.arrays import Array
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize

BRAINCASE_MM = 85.0
"""Below the top of the hair: brows begin 95 to 125 mm below the top of an adult's head."""
CELL_MM = 15.0
"""A braincase's dents and bulges are as wide as that and wider: what lies closer errs alike."""
MISFIT_MM = 4.0
"""Standard deviation of a braincase from an ellipsoid."""
FEWEST = 12
"""Cells: 27 cm2 of skin, half a forehead."""
AXES_MM = np.array([97.0, 76.0, 97.0])
"""Half the length and breadth of heads (ANSUR II, both sexes: 195 and 151 mm), and from the level of
the brows to the top."""
SIZE, SHAPE = 0.06, 0.04
"""Standard deviations, relative: of all three together (children too), and of each by itself."""
SKIN = Noise("skin from a braincase", cauchy=2.5, known=1.0)
FAR_MM = 100.0  # of a centre from where it is first looked for: nothing is known of it


@dataclass(frozen=True)
class HeadTop:
    """height_mm: of the top of the head over the floor.  sigma_mm: of that."""

    height_mm: float
    sigma_mm: float


@dataclass(frozen=True, eq=False)
class _Ellipsoid:
    """centre: (3,) mm.  size, shape: logarithms of the axes over the usual, all and each, (4,)."""

    centre: Array
    size: Array

    @property
    def axes(self) -> Array:
        return AXES_MM * np.exp(self.size[0] + self.size[1:])

    @property
    def top_mm(self) -> float:
        return float(self.centre[2] + self.axes[2])

    def distances(self, points: Array) -> tuple[Array, Array]:
        """(N,) mm of points (N, 3) from the surface, to first order, and by centre and size (N, 7)."""
        scaled = (points - self.centre) / self.axes
        radius = np.linalg.norm(scaled, axis=1)
        slope = scaled / self.axes / radius[:, None]
        steep = np.linalg.norm(slope, axis=1)
        by_axes = -slope * (points - self.centre)
        rows = np.column_stack([-slope, by_axes.sum(axis=1), by_axes]) / steep[:, None]
        return (radius - 1.0) / steep, rows


def estimate_head_top(skin: Array, hair_top_mm: float) -> HeadTop | None:
    """From the skin (N, 3) mm of a head, in the body's frame (x ahead, z up), and how high its hair
    reaches; None where no skin shows. Where forehead and temples are covered it is no more than
    that the head ends between skin and hair.
    """
    if not len(skin):
        return None
    case, low = skin[skin[:, 2] > hair_top_mm - BRAINCASE_MM], float(skin[:, 2].max())
    _, first = np.unique(np.floor(case / CELL_MM).astype(int), axis=0, return_index=True)
    if len(first) < FEWEST:
        return HeadTop(0.5 * (low + hair_top_mm), float((hair_top_mm - low) / np.sqrt(12.0)))
    solution = _fit(case[first], hair_top_mm)
    covariance = solution.covariance
    by_top = np.zeros(7)
    by_top[2], by_top[3], by_top[6] = 1.0, solution.state.axes[2], solution.state.axes[2]
    sigma = float(np.sqrt(by_top @ covariance @ by_top))
    return _between(solution.state.top_mm, sigma, low, hair_top_mm)


def _fit(places: Array, hair_top_mm: float) -> Solution[_Ellipsoid]:
    """To skin at places (N, 3), with what is known of heads as priors."""
    middle = np.array([places[:, 0].max() - AXES_MM[0], places[:, 1].mean(), 0.0])
    middle[2] = hair_top_mm - AXES_MM[2]
    known = np.concatenate([np.full(3, FAR_MM), [SIZE], np.full(3, SHAPE)])

    def blocks(head: _Ellipsoid) -> list[Block]:
        distances, rows = head.distances(places)
        off = np.concatenate([head.centre - middle, head.size])
        return [
            Block(distances, lambda: rows, slice(0, 7), SKIN, MISFIT_MM),
            Block(off, lambda: np.eye(7), slice(0, 7), EXACT, known),
        ]

    def moved(head: _Ellipsoid, step: Array) -> _Ellipsoid:
        return _Ellipsoid(head.centre + step[:3], head.size + step[3:])

    return minimize(_Ellipsoid(middle, np.zeros(4)), blocks, moved, unknowns=7)


def _between(estimate: float, sigma: float, low: float, high: float) -> HeadTop:
    """What is left of a normal distribution between what skin and hair leave open."""
    ends = (low - estimate) / sigma, (high - estimate) / sigma
    left = truncnorm(*ends, loc=estimate, scale=sigma)
    return HeadTop(float(left.mean()), float(left.std()))
