"""The approaches of 4.2, and every rival projector at the same points, all as camera and sheets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from bodyscan.arrays import Array
from bodyscan.calibration.boundary_points import BoundaryPoints, subsample
from bodyscan.calibration.light_planes import fit_light_planes
from bodyscan.calibration.pinhole_projector import fit_pinhole
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets
from bodyscan.laboratory.rivals.baseline_models import (
    fit_invariable_baseline,
    fit_variable_baseline,
)
from bodyscan.laboratory.rivals.remapped_pinhole import fit_remapped_pinhole
from bodyscan.laboratory.rivals.targets import (
    LocatedBoards,
    StripedShot,
    Target,
    by_matrix,
    locate_again,
)


@dataclass(frozen=True, eq=False)
class Approach:
    """A calibrated pair as needed for triangulation, whatever the models."""

    name: str
    camera: Camera
    sheets: LightSheets


def pinhole_by_stage(target: Target, shots: Sequence[StripedShot], readings: Array) -> Approach:
    """Approach (i) of the chapter: a 3 x 4 and a 2 x 4 matrix from a slide stage, without a lens,
    and with the index used as a place on the projector's slide."""
    return _fit("(i)", by_matrix(target, shots, readings), target, pinhole_planes)


def mended_pinhole_by_stage(target: Target, stage: LocatedBoards) -> Approach:
    """Approach (i) with what it lacks: Tsai's camera with its lens, and a re-mapped index."""
    return _fit("(i) mended", stage, target, remapped_planes)


def planes_by_stage_camera(
    name: str, target: Target, stage: LocatedBoards, shots: Sequence[StripedShot]
) -> Approach:
    """Approach (ii): Tsai's camera from the slide stage, planes from the reference plane.

    This follows the chapter's text, although its heading says `calibrated by slide stage`.
    """
    return _fit(name, locate_again(target, shots, stage.camera), target, free_planes)


Model = Callable[[BoundaryPoints, int, Axis], LightPlanes]


def free_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """One free plane per stripe (Eq. 6)."""
    return fit_light_planes(points, stripes, direction).planes


MATRIX_POINTS = 20000
"""This many points determine the few numbers of a matrix far better than the model fits."""


def pinhole_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Planes of the 2 x 4 matrix of Bolles et al. 1981."""
    few = subsample(points, MATRIX_POINTS)
    fitted = fit_pinhole(few.points, few.index.astype(float))
    return fitted.planes(stripes, direction)


def remapped_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Planes of the 2 x 4 matrix with a re-mapped index."""
    few = subsample(points, MATRIX_POINTS)
    return fit_remapped_pinhole(few.points, few.index.astype(float), stripes, direction)


PROJECTORS: dict[str, Model] = {
    "2 x 4 matrix": pinhole_planes,
    "2 x 4 matrix, index re-mapped": remapped_planes,
    "invariable baseline": partial(fit_invariable_baseline, fit_tilt=False),
    "invariable baseline, tilted": fit_invariable_baseline,
    "variable baseline": partial(fit_variable_baseline, fit_tilt=False),
    "variable baseline, tilted": fit_variable_baseline,
    "free planes": free_planes,
}
"""Every model of the projector that the chapter names. `tilted`: the baseline's direction in the
image is estimated too, instead of being assumed to be the camera's x axis."""


def rivals(target: Target, where: LocatedBoards) -> list[Approach]:
    """Each model fitted to the same boundaries."""
    return [_fit(name, where, target, model) for name, model in PROJECTORS.items()]


def _fit(name: str, where: LocatedBoards, target: Target, model: Model) -> Approach:
    projector = target.projector
    sheets = model(where.points, projector.stripes, projector.direction)
    return Approach(name, where.camera, sheets)
