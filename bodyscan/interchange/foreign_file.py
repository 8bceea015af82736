"""A file written by another program: where its words are, and its numbers checked before use."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import CalibrationFileError
from bodyscan.files.regular import read_regular
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform

MOST_BYTES = 100_000_000
"""mrcal's files hold all corners of a calibration as well, some megabytes."""
ROTATION_TOLERANCE = 1e-3
"""Deviation of R R^T from 1: a rotation written with four digits keeps it; a milliradian is a
millimetre at a metre. What is within it is replaced by the nearest rotation."""
SAME_UNIT = "the file as that program wrote it"


@dataclass(frozen=True)
class ForeignFile:
    """path: of the file. text: its content, "" if it has none."""

    path: Path
    text: str = ""

    @staticmethod
    def read(path: Path) -> ForeignFile:
        """Read a text file. Raises CalibrationFileError if it is
        not text, BadInput for a folder or a pipe."""
        empty = ForeignFile(path)
        try:
            data = read_regular(path, MOST_BYTES)
            if len(data) > MOST_BYTES:
                raise empty.error(f"is longer than {MOST_BYTES:,} bytes: this cannot be right")
            return ForeignFile(path, data.decode("utf-8-sig"))
        except FileNotFoundError:
            raise empty.error("there is no such file") from None
        except UnicodeDecodeError:
            raise empty.error("is not UTF-8 text") from None
        except OSError as fault:
            raise empty.error(f"cannot be read: {fault.strerror or fault}") from None

    def where(self, word: str = "", after: str = "") -> str:
        """The file and the line in which a word occurs first, as a key if it does so anywhere;
        after another word if one is given."""
        place = 0
        for part in filter(None, (after, word)):
            alone = rf"(?<![\w.-]){re.escape(part)}(?![\w-])"
            as_key = rf"{alone}(?=[\"']?\s*[:=\]>]|\s+type_id)"
            for pattern in (as_key, alone):
                found = re.compile(pattern).search(self.text, place)
                if found:
                    break
            else:
                return str(self.path)
            place = found.start()
        line = self.text.count("\n", 0, place) + 1
        return f"{self.path}:{line}" if after or word else str(self.path)

    def error(
        self, what: str, word: str = "", remedy: str = "", *, after: str = ""
    ) -> CalibrationFileError:
        """An error about the file, or about what a word in it names."""
        named = f"{after + '.' if after else ''}{word}: " if word else ""
        return CalibrationFileError(
            named + what,
            where=self.where(word, after),
            remedy=remedy or f"give {SAME_UNIT}",
        )

    def require(self, table: Mapping[str, Any], words: Iterable[str], key: str) -> None:
        """Raises CalibrationFileError unless the table of that name has all of the words."""
        for word in words:
            if word not in table:
                raise self.error(f"has no {word}", key, f"it has {', '.join(table)}")

    def numbers(self, value: Any, word: str, counts: Sequence[int], *, after: str = "") -> Array:
        """`value` as a flat array of one of these lengths; of any length if there are none."""
        try:
            array: Array = np.asarray(value, np.float64).ravel()
        except (TypeError, ValueError):
            raise self.error(
                f"holds what is not a number ({value!r:.60})", word, after=after
            ) from None
        if counts and len(array) not in counts:
            wanted = " or ".join(map(str, counts))
            raise self.error(f"holds {len(array)} numbers, not {wanted}", word, after=after)
        if not np.all(np.isfinite(array)):
            raise self.error("holds a number that is not finite", word, after=after)
        return array

    def matrix(self, value: Any, word: str, *, after: str = "") -> Array:
        """A of Eq. 1, (3, 3), from nine numbers row by row."""
        matrix = self.numbers(value, word, (9,), after=after).reshape(3, 3)
        if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
            raise self.error(
                f"has focal lengths {matrix[0, 0]:g} and {matrix[1, 1]:g}, which must be positive",
                word,
                after=after,
            )
        if matrix[1, 0] != 0.0 or not np.array_equal(matrix[2], [0.0, 0.0, 1.0]):
            raise self.error(
                "is not a camera matrix: below its diagonal stand zeros, and 1 at its end", word,
                "is it transposed, or a projection of three by four?", after=after,
            )  # fmt: skip
        return matrix

    def four(self, value: Any, word: str, *, after: str = "") -> Array:
        """A of Eq. 1 from fx, fy, cx, cy."""
        fx, fy, cx, cy = self.numbers(value, word, (4,), after=after)
        return self.matrix([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], word, after=after)

    def lens(self, value: Any, word: str, *, after: str = "") -> Lens:
        """The lens with OpenCV's coefficients in OpenCV's order, 0 to 14 of them."""
        given = self.numbers(value, word, (0, 1, 2, 3, 4, 5, 8, 12, 14), after=after)
        coefficients = np.zeros(max(len(given), 5))
        coefficients[: len(given)] = given
        try:
            return lens_from_opencv(coefficients)
        except ValueError as error:
            raise self.error(
                str(error), word, "calibrate it with a lens that there is here", after=after
            ) from None

    def size(self, value: Any, word: str, *, after: str = "") -> tuple[int, int]:
        """Width and height of an image, px."""
        width, height = self.numbers(value, word, (2,), after=after)
        if width != int(width) or height != int(height) or width < 1 or height < 1:
            raise self.error(
                f"is not the size of a picture ({width:g} x {height:g})", word, after=after
            )
        return int(width), int(height)

    def pose(
        self, rotation: Any, translation: Any, words: tuple[str, str], *, after: str = ""
    ) -> RigidTransform:
        """A pose from a rotation matrix row by row, or a rotation vector, and a translation."""
        given = self.numbers(rotation, words[0], (3, 9), after=after)
        shift = self.numbers(translation, words[1], (3,), after=after)
        if len(given) == 3:
            return RigidTransform.from_rotation_vector(given, shift)
        matrix = given.reshape(3, 3)
        off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if off > ROTATION_TOLERANCE:
            raise self.error(
                f"is not a rotation: R times its transpose is off the identity by {off:.2g}",
                words[0],
                after=after,
            )
        if np.linalg.det(matrix) < 0.0:
            raise self.error(
                "is mirrored (its determinant is -1): no camera stands so",
                words[0],
                "is an axis turned round, such as y or z?",
                after=after,
            )
        return RigidTransform.from_matrix(np.column_stack([matrix, shift]))
