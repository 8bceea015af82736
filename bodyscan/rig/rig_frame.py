"""How the rig frame is fixed."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator

from bodyscan.files.model import Model, Name, Problem, ShotName, did_you_mean

Vector = tuple[float, float, float]


class RigFrame(Model):
    """How the rig frame is fixed: by a board in one shot, or by one pair at its nominal pose.

    With `pair`: that pair's camera stands exactly at its `nominal` pose (image upright: its y axis
    points down as far as possible); without a nominal pose the rig frame is the camera frame
    itself. With neither `pair` nor `shot`, the first pair of the file is used.

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
        return _problems(self)

    def missing_shot(self, shots: Collection[str]) -> str | None:
        """What is wrong if the shot that fixes the frame is none of `shots`, in words."""
        if self.shot is None or self.shot in shots:
            return None
        hint = did_you_mean(self.shot, shots)
        return f"rig_frame.shot: there is no shot '{self.shot}'{hint} in the calibration captures"


def _problems(frame: RigFrame) -> Iterator[Problem]:
    if frame.shot is not None and frame.pair is not None:
        yield ("pair",), "cannot fix the rig frame together with shot: give one of the two"
    if frame.board is not None and frame.shot is None:
        yield ("board",), "needs shot: the shot in which this board fixes the rig frame"
    lengths = {key: math.hypot(*getattr(frame, key)) for key in ("x_axis", "y_axis")}
    for key, length in lengths.items():
        if length == 0:
            yield (key,), "must not be zero"
    cosine = sum(x * y for x, y in zip(frame.x_axis, frame.y_axis, strict=True))
    if all(lengths.values()) and abs(cosine) > 1e-6 * lengths["x_axis"] * lengths["y_axis"]:
        yield ("y_axis",), "must be perpendicular to x_axis"
