"""The lens models. To add one, put a file into this folder and its class into `LENSES`."""

from __future__ import annotations

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.fisheye import Fisheye
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Radial, Rational

FAMILY: tuple[type[Lens], ...] = (Radial, Brown, Rational, Fisheye)
"""The models tried for a camera. Each of the first three has all coefficients of the one before and
more; a fisheye has a picture where theirs, which go by the tangent, run out of range."""

LENSES: dict[str, type[Lens]] = {lens.kind: lens for lens in FAMILY}
"""By name in files, the simplest first: the first that has all given coefficients is chosen."""


def lens_from_opencv(coefficients: Array) -> Lens:
    """The simplest lens with OpenCV's distortion coefficients k1, k2, p1, p2, k3, ... (5,) or more.

    Raises ValueError if there is none.
    """
    for kind in LENSES.values():
        lens = kind.from_opencv(coefficients)
        if lens is not None:
            return lens
    raise ValueError(f"no supported lens model has distortion coefficients {coefficients.tolist()}")
