"""A camera as named numbers, the form in which files hold it: A, the lens, the image size.

`lens` names the kind of lens; if it is missing, the lens is the chapter's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.lenses import LENSES
from bodyscan.geometry.lenses.radial import Radial

SIZE = ("width", "height")


def camera_to_fields(camera: Camera) -> dict[str, Any]:
    """alpha, beta, gamma, u0, v0, the kind of lens, its coefficients by name, width and height."""
    own = {name: getattr(camera, name) for name in (*MATRIX, *SIZE)}
    lens = {name: getattr(camera.lens, name) for name in camera.lens.names}
    kind = {} if camera.lens.kind == Radial.kind else {"lens": camera.lens.kind}
    return own | lens | kind


def camera_from_fields(content: Mapping[str, Any]) -> Camera:
    """The camera whose fields `camera_to_fields` returned.

    Raises ValueError for an unknown lens, a missing or surplus name, or a value that is not finite.
    """
    numbers = dict(content)
    kind = numbers.pop("lens", Radial.kind)
    if kind not in LENSES:
        raise ValueError(f"a lens {kind!r} is unknown, there are {', '.join(LENSES)}")
    lens = LENSES[kind]()
    expected = {*MATRIX, *lens.names, *SIZE}
    if numbers.keys() != expected:
        odd = sorted(numbers.keys() ^ expected)
        raise ValueError(f"a camera with a {kind} lens lacks or does not have {', '.join(odd)}")
    for name, value in numbers.items():
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise ValueError(f"{name} of a camera is {value!r}, not a number")
    coefficients = {name: numbers.pop(name) for name in lens.names}
    return Camera(lens=type(lens)(**coefficients), **numbers)
