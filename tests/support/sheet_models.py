"""Every model of smooth light, about one pinhole projector."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import SmoothSheets

STRIPES = 200
MIDDLE = np.array([20.0, -30.0, 1300.0])
# f = 300 stripes, axis at stripe 80, 250 mm above the camera, looking down on the middle.
DOWN, AXIS = np.array([0.02, 0.98, -0.2]), np.array([-0.01, 0.2, 0.98])
MATRIX = np.stack(
    [300 * np.append(DOWN, 250.0) + 80 * np.append(AXIS, -20.0), np.append(AXIS, -20.0)]
)
PINHOLE = LensSheets.from_matrix(MATRIX, MIDDLE, STRIPES, "horizontal")


def models(seed: int) -> list[SmoothSheets]:
    """Each kind, moved a little away from a pinhole at random, with some covariance."""
    rng = np.random.default_rng(seed)
    made: list[SmoothSheets] = [PINHOLE.with_lens(terms) for terms in (0, 1, 2, 4)]
    made += [BowedSheets.from_pinhole(PINHOLE, terms) for terms in (1, 3)]
    made += [PINHOLE.with_lens(terms) for terms in (5, 8)]
    return [moved(model, rng) for model in made]


def by_offset(
    model: SmoothSheets, rays: Array, s: Array, depth: Array
) -> tuple[Array, Array, Array]:
    """Depths (N,) after one more step of Newton's method, dz/ds and variance, all from the offset."""
    points = rays * depth[:, None]
    offset = model.offset(points, model.evaluate(s), parameters=True)
    before, after = (model.offset(points, model.evaluate(s + by)).value for by in (-1e-3, 1e-3))
    along, jacobian = np.sum(offset.by_point * rays, axis=-1), offset.by_parameter
    assert jacobian is not None
    variance = np.sum((jacobian @ model.covariance) * jacobian, axis=-1)
    return depth - offset.value / along, -500.0 * (after - before) / along, variance / along**2


Sheets = TypeVar("Sheets", bound=SmoothSheets)


def moved(model: Sheets, rng: np.random.Generator) -> Sheets:
    size = np.full(len(model.covariance), 0.01)
    if isinstance(model, BowedSheets):
        size[2:24] *= 0.1
        size[24:] *= 0.5
    else:
        size[3:6], size[6:8] = 5.0, 1.0
    step = size * rng.standard_normal(len(size))
    spread = 1e-4 * size[:, None] * rng.standard_normal((len(size), len(size)))
    return replace(model.retract(step), covariance=spread @ spread.T)
