"""What fixes the gauge of a rig: its frame of reference (`RigFrame`) and its size (`Reference`)."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import Annotated

from pydantic import Field, PositiveFloat

from bodyscan.files.model import Model, Name, Problem, ShotName, did_you_mean

Vector = tuple[float, float, float]


class RigFrame(Model):
    """How the rig frame is fixed: by a board in one shot, or by one pair at its nominal pose.

    With `pair`: that pair's camera has exactly its `nominal` pose (image upright: its y axis points
    down as far as possible); without a nominal pose the rig frame is the camera frame. With neither
    `pair` nor `shot`, the first pair of the file is used.

    With `shot`: the board's origin lies at `origin_mm`, its x axis points along `x_axis` and its
    y axis along `y_axis` in the rig frame. The default is a board that lies on the floor, printed
    side up, with its columns running the way the subject faces.
    """

    shot: ShotName | None = None
    board: Name | None = None
    origin_mm: Vector = (0.0, 0.0, 0.0)
    x_axis: Vector = (1.0, 0.0, 0.0)
    y_axis: Vector = (0.0, -1.0, 0.0)
    pair: Name | None = None

    def problems(self) -> Iterator[Problem]:
        if self.shot is not None and self.pair is not None:
            yield ("pair",), "cannot fix the rig frame together with shot: give one of the two"
        if self.board is not None and self.shot is None:
            yield ("board",), "needs shot: the shot in which this board fixes the rig frame"
        lengths = {key: math.hypot(*getattr(self, key)) for key in ("x_axis", "y_axis")}
        for key, length in lengths.items():
            if length == 0:
                yield (key,), "must not be zero"
        cosine = sum(x * y for x, y in zip(self.x_axis, self.y_axis, strict=True))
        if all(lengths.values()) and abs(cosine) > 1e-6 * math.prod(lengths.values()):
            yield ("y_axis",), "must be perpendicular to x_axis"

    def missing_shot(self, shots: Collection[str]) -> str | None:
        """Return an error message if the shot that fixes the frame is none of `shots`, else None."""
        if self.shot is None or self.shot in shots:
            return None
        hint = did_you_mean(self.shot, shots)
        return f"rig_frame.shot: there is no shot '{self.shot}'{hint} in the calibration captures"


class Reference(Model):
    """A certified length in calibration captures, of one board or of a bar that carries two boards.

    length_mm: of one board, from a row's first to its last corner; of two, between their centres.
    sigma_mm: standard deviation of the length, from the certificate.
    """

    name: Name
    boards: Annotated[tuple[Name, ...], Field(min_length=1, max_length=2)]
    length_mm: PositiveFloat
    sigma_mm: PositiveFloat
