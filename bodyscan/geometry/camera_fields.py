"""A camera as names and numbers, as files hold it: A's, the lens's, the image's size.

`lens` names the kind of the lens; left out it is the chapter's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.lenses import LENSES
from bodyscan.geometry.lenses.radial import Radial

SIZE = ("width", "height")


def to_fields(camera: Camera) -> dict[str, Any]:
    """alpha, beta, gamma, u0, v0, the lens's kind and coefficients by name, width, height."""
    own = {name: getattr(camera, name) for name in (*MATRIX, *SIZE)}
    lens = {name: getattr(camera.lens, name) for name in camera.lens.names}
    kind = {} if camera.lens.kind == Radial.kind else {"lens": camera.lens.kind}
    return own | lens | kind


def from_fields(content: Mapping[str, Any]) -> Camera:
    """The camera that `to_fields` wrote down.

    Raises ValueError for an unknown lens, a name too many or too few, or what is no finite number.
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
