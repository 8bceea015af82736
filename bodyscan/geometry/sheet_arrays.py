"""Light sheets of any kind as plain arrays and back, exact to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.bowed_sheets import BOW_DEGREE, PLANE_DEGREE, BowedSheets
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform

KINDS = ("planes", "smooth-planes", "bowed", "lens")


def sheets_to_arrays(sheets: LightSheets) -> dict[str, Array]:
    """Arrays that, with `sheets.kind` and `sheets.direction`, describe the sheets completely."""
    if isinstance(sheets, LightPlanes):
        return {"planes": sheets.coefficients, "covariance": sheets.covariance}
    if isinstance(sheets, SmoothSheets):
        return {
            "projector_from_camera": sheets.projector_from_camera.matrix,
            "middle": sheets.middle,
            "stripes": np.array(float(sheets.stripes)),
            "parameters": sheets.parameters,
            "covariance": sheets.covariance,
        }
    raise TypeError(f"no sheets of light: {type(sheets).__name__}")


def sheets_from_arrays(kind: str, arrays: Mapping[str, Any], direction: Axis) -> LightSheets:
    """Rebuild the sheets from what `sheets_to_arrays` returned.

    Raises ValueError for an unknown kind or arrays of the wrong size, KeyError for a missing one.
    """
    if kind not in KINDS:
        raise ValueError(f"sheets of light of an unknown kind, {kind!r}")
    if kind == "planes":
        return LightPlanes(arrays["planes"], arrays["covariance"], direction)
    matrix, parameters = arrays["projector_from_camera"], arrays["parameters"]
    frame = RigidTransform(matrix[:3, :3].copy(), matrix[:3, 3].copy())
    stripes, middle, covariance = int(arrays["stripes"]), arrays["middle"], arrays["covariance"]
    if kind == "lens":
        return LensSheets(frame, middle, stripes, direction, parameters, covariance)
    bow, over = divmod(len(parameters) - 3 * (PLANE_DEGREE + 1), BOW_DEGREE + 1)
    if bow < 0 or over != (kind == "bowed") or (bow > 0) != (kind == "bowed"):
        raise ValueError(f"{len(parameters)} parameters do not make {kind} sheets of light")
    return BowedSheets(frame, middle, stripes, direction, parameters, covariance, bow)
