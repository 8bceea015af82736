"""The lenses there are.  A new one is a file in this folder and its name in `LENSES`."""

from __future__ import annotations

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.brown import Brown
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.lenses.rational import Rational

LENSES: dict[str, type[Lens]] = {lens.kind: lens for lens in (Radial, Brown, Rational)}
"""By their names in files, the simplest first; of those that have given coefficients of OpenCV's the
first is taken."""

FAMILY: tuple[type[Lens], ...] = (Radial, Brown, Rational)
"""Those that a camera is tried with, each with all coefficients of the one before it and more."""


def family_up_to(kind: type[Lens]) -> tuple[type[Lens], ...]:
    """Those of the family up to a kind; it alone if it is not of the family."""
    return FAMILY[: FAMILY.index(kind) + 1] if kind in FAMILY else (kind,)


def lens_from_opencv(coefficients: Array) -> Lens:
    """The lens with OpenCV's distortion coefficients k1, k2, p1, p2, k3, ... (5,) or more.

    Raises ValueError if there is none.
    """
    for kind in LENSES.values():
        lens = kind.from_opencv(coefficients)
        if lens is not None:
            return lens
    raise ValueError(f"no lens here has all of the distortion coefficients {coefficients.tolist()}")
