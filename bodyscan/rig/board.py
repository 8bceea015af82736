"""A calibration board as the rig file describes it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, PositiveFloat, model_validator

from bodyscan.files.model import Model, Name, Problem, did_you_mean

MARKERS_IN = {
    **{
        f"DICT_{bits}X{bits}_{count}": count
        for bits in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
    "DICT_ARUCO_MIP_36h12": 250,
}
"""Number of markers in each of OpenCV's dictionaries: a rig file is checked without OpenCV."""

LARGEST_DICTIONARIES = (
    *(f"DICT_{bits}X{bits}_1000" for bits in (4, 5, 6, 7)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36h11",
    "DICT_ARUCO_MIP_36h12",
)
"""One dictionary per family, to find out which one a board was printed with. Those of few bits are
left out: their markers are found in any texture."""


class Board(Model):
    """A flat board.

    columns, rows: number of squares, not of corners; of an aprilgrid, number of tags.
    scale: how many times larger than described the print is; on reading it goes into square_mm and
        marker_mm, and is 1 afterwards.
    square_mm: side of a square; of an aprilgrid, the distance from one tag to the next.
    stretch: how many times as high as wide the squares are; square_mm is their width.

    Board frame: origin at the first square's outer corner (of the checkered area), x along the
    columns, y along the rows (down, as printed), z away from whoever looks at the front.
    """

    name: Name
    kind: Literal["checkerboard", "charuco", "aprilgrid"] = "checkerboard"
    columns: Annotated[int, Field(ge=3, le=200)]
    rows: Annotated[int, Field(ge=3, le=200)]
    square_mm: PositiveFloat
    scale: Annotated[float, Field(gt=0.8, lt=1.25)] = 1.0
    stretch: Annotated[float, Field(gt=0.8, lt=1.25)] = 1.0
    marker_mm: PositiveFloat | None = None
    dictionary: str = "DICT_4X4_1000"
    legacy_layout: bool = False
    first_marker: Annotated[int, Field(ge=0)] = 0
    margin_mm: Annotated[float, Field(ge=0)] = 0.0
    faces: Literal[1, 2] = 1
    thickness_mm: Annotated[float, Field(ge=0)] = 0.0
    flatness_mm: Annotated[float, Field(ge=0)] | None = None

    @property
    def size_mm(self) -> tuple[float, float]:
        """Of the checkered area, along its columns and along its rows."""
        return self.columns * self.square_mm, self.rows * self.square_mm * self.stretch

    @property
    def flatness_sigma_mm(self) -> float:
        """Prior standard deviation of the height difference between the lowest and highest corners.

        By default 0.5 mm per metre of the diagonal, as of a print glued to aluminium composite.
        """
        if self.flatness_mm is not None:
            return self.flatness_mm
        return 5e-4 * self.square_mm * math.hypot(self.columns, self.rows)

    @property
    def is_ambiguous(self) -> bool:
        """Whether the print looks the same rotated by 180 degrees, or from its other face."""
        symmetric = self.faces == 2 or (self.columns + self.rows) % 2 == 0
        return self.kind == "checkerboard" and symmetric

    @property
    def marker_count(self) -> int:
        """Number of markers on all faces: one per second square of a charuco board, else per square."""
        squares = self.columns * self.rows
        each = {"checkerboard": 0, "charuco": squares // 2, "aprilgrid": squares}[self.kind]
        return self.faces * each

    @model_validator(mode="before")
    @classmethod
    def _kalibrs_tags(cls, keys: Any) -> Any:
        """Give an aprilgrid Kalibr's tags unless the file says otherwise."""
        if isinstance(keys, dict) and keys.get("kind") == "aprilgrid":
            return {"dictionary": "DICT_APRILTAG_36h11", **keys}
        return keys

    @model_validator(mode="before")
    @classmethod
    def _apply_scale(cls, keys: Any) -> Any:
        """Put a valid scale into the lengths of the print."""
        scale = keys.get("scale") if isinstance(keys, dict) else None
        if not isinstance(scale, float) or not 0.8 < scale < 1.25:
            return keys
        lengths = {key: keys.get(key) for key in ("square_mm", "marker_mm")}
        scaled = {k: v * scale for k, v in lengths.items() if isinstance(v, int | float)}
        return {**keys, **scaled, "scale": 1.0}

    def problems(self) -> Iterator[Problem]:
        if self.faces == 1 and self.thickness_mm > 0:
            yield ("thickness_mm",), "is for a board with faces: 2 (it is between the two prints)"
        if self.kind == "checkerboard":
            if self.marker_mm is not None:
                yield ("marker_mm",), "is for boards with markers; a checkerboard has none"
            return
        if self.marker_mm is None:
            wrong = f"is missing: a board of kind {self.kind} needs the side of its markers"
            yield ("marker_mm",), wrong
        elif self.marker_mm >= self.square_mm:
            wrong = f"must be less than square_mm ({self.square_mm:g}) (got {self.marker_mm:g})"
            yield ("marker_mm",), wrong
        if self.kind == "aprilgrid" and self.faces == 2:
            yield ("faces",), "must be 1: an aprilgrid's back is a board of its own"
        if self.kind == "aprilgrid" and not self.dictionary.startswith("DICT_APRILTAG"):
            wrong = f"must be of AprilTags, such as DICT_APRILTAG_36h11 (got {self.dictionary!r})"
            yield ("dictionary",), wrong
        if self.dictionary not in MARKERS_IN:
            hint = did_you_mean(self.dictionary, MARKERS_IN)
            wrong = f"is not one of OpenCV's dictionaries{hint} (got {self.dictionary!r})"
            yield ("dictionary",), wrong
        elif self.first_marker + self.marker_count > MARKERS_IN[self.dictionary]:
            last, end = MARKERS_IN[self.dictionary] - 1, self.first_marker + self.marker_count - 1
            wrong = f"holds markers 0 to {last}, but this board needs {self.first_marker} to {end}"
            yield ("dictionary",), wrong


def find_dictionary_family(dictionary: str) -> str:
    """Return a dictionary's family, which shares its first markers: DICT_4X4 of DICT_4X4_50."""
    head, _, count = dictionary.rpartition("_")
    return head if count.isdigit() else dictionary
