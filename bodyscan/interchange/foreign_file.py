"""A file written by another program: its numbers checked before use, its errors by line."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import CalibrationFileError
from bodyscan.files.reading import read_regular
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.found_camera import FoundCamera
from bodyscan.interchange.rig_format import opencv_coefficients

MAX_BYTES = 100_000_000  # mrcal's files hold all corners of a calibration, some megabytes


@dataclass(frozen=True)
class ForeignFile:
    """A file and its text; its methods check values and raise CalibrationFileError, by line."""

    path: Path
    text: str = ""

    @staticmethod
    def read(path: Path) -> ForeignFile:
        """Read a text file. Raises CalibrationFileError if it is not text, BadInput for a pipe."""
        empty = ForeignFile(path)
        try:
            data = read_regular(path, MAX_BYTES)
            if len(data) > MAX_BYTES:
                raise empty.error(f"is longer than {MAX_BYTES:,} bytes: this cannot be right")
            return ForeignFile(path, data.decode("utf-8-sig"))
        except FileNotFoundError:
            raise empty.error("there is no such file") from None
        except UnicodeDecodeError:
            raise empty.error("is not UTF-8 text") from None
        except OSError as fault:
            raise empty.error(f"cannot be read: {fault.strerror or fault}") from None

    def where(self, word: str = "", after: str = "") -> str:
        """The file and the line of the first occurrence of a word, preferably as a key.

        after: another word, after which it occurs.
        """
        position = 0
        for part in filter(None, (after, word)):
            alone = rf"(?<![\w.-]){re.escape(part)}(?![\w-])"
            as_key = rf"{alone}(?=[\"']?\s*[:=\]>]|\s+type_id)"
            for pattern in (as_key, alone):
                found = re.compile(pattern).search(self.text, position)
                if found:
                    break
            else:
                return str(self.path)
            position = found.start()
        line = self.text.count("\n", 0, position) + 1
        return f"{self.path}:{line}" if after or word else str(self.path)

    def error(
        self, what: str, word: str = "", remedy: str = "", *, after: str = ""
    ) -> CalibrationFileError:
        """An error about the file, or about what a word in it names."""
        named = f"{after + '.' if after else ''}{word}: " if word else ""
        return CalibrationFileError(
            named + what,
            where=self.where(word, after),
            remedy=remedy or "give the file as that program wrote it",
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
                "is not a camera matrix, which has zeros below its diagonal and 1 at its end", word,
                "check that it is not transposed, nor a projection of three by four", after=after,
            )  # fmt: skip
        return matrix

    def pinhole_matrix(self, value: Any, word: str, *, after: str = "") -> Array:
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
                str(error), word, "calibrate it with a supported lens", after=after
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
        """A pose from a rotation (vector, or matrix row by row) and a translation.

        A matrix is replaced by the nearest rotation.
        """
        given = self.numbers(rotation, words[0], (3, 9), after=after)
        shift = self.numbers(translation, words[1], (3,), after=after)
        if len(given) == 3:
            return RigidTransform.from_rotation_vector(given, shift)
        matrix = given.reshape(3, 3)
        # Four digits suffice; a milliradian is a millimetre at a metre.
        deviation = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if deviation > 1e-3:
            raise self.error(
                f"is not a rotation: R times its transpose differs from 1 by {deviation:.2g}",
                words[0],
                after=after,
            )
        if np.linalg.det(matrix) < 0.0:
            raise self.error(
                "is a reflection (its determinant is -1), which no camera's pose is",
                words[0],
                "check whether an axis, such as y or z, has the opposite direction",
                after=after,
            )
        return RigidTransform.from_matrix(np.column_stack([matrix, shift]))


# What the TOML of caliscope and of aniposelib share: a table of OpenCV's numbers per camera.

TOML_NOTE = (
    "# Pixel centres at whole numbers; x_camera = R(rotation) x_rig + translation. matrix holds the\n"
    "# skew, which OpenCV's functions ignore: use it with pixels sheared to\n"
    "# u - skew / fy * (v - cy), v.\n"
)


def read_toml(file: ForeignFile) -> dict[str, Any]:
    """Parse a TOML file. Raises CalibrationFileError, with the line, if it is not TOML."""
    try:
        return tomllib.loads(file.text)
    except tomllib.TOMLDecodeError as error:
        raise file.error(f"is not TOML: {error}") from None


def read_camera_table(file: ForeignFile, table: dict[str, Any], key: str) -> FoundCamera:
    """Read the camera in a table; key: of the table, as written in the file."""
    file.require(table, ("size", "matrix", "distortions"), key)
    if table.get("fisheye", False):
        raise file.error(
            "is OpenCV's fisheye lens, which is not supported", "fisheye",
            "calibrate it with an ordinary lens", after=key,
        )  # fmt: skip
    pose = None
    if "rotation" in table and "translation" in table:
        words = "rotation", "translation"
        pose = file.pose(table["rotation"], table["translation"], words, after=key)
    return FoundCamera(
        file.matrix(table["matrix"], "matrix", after=key),
        file.lens(table["distortions"], "distortions", after=key),
        file.size(table["size"], "size", after=key),
        pose,
        file.where(key),
    )


def format_camera_table(
    name: str, camera: Camera, camera_from_rig: RigidTransform, mm_a_unit: float
) -> str:
    """Format the lines for size, matrix, distortions, rotation and translation.

    Raises BadInput for a lens that OpenCV does not have.
    """
    return "".join(
        f"{word} = {value!r}\n"
        for word, value in (
            ("size", [camera.width, camera.height]),
            ("matrix", camera.matrix.tolist()),
            ("distortions", opencv_coefficients(name, camera).tolist()),
            ("rotation", camera_from_rig.rotation_vector.tolist()),
            ("translation", (camera_from_rig.translation / mm_a_unit).tolist()),
        )
    )
