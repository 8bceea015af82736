"""A file written by another program: its numbers checked before use, its errors by line."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import CalibrationFileError
from bodyscan.files.reading import read_regular
from bodyscan.files.yaml_file import Place, YamlError, parse_scalar, parse_yaml
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.fisheye import Fisheye
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform

MAX_BYTES = 100_000_000  # mrcal's files hold all corners of a calibration, some megabytes
MAX_VALUES = 1_000_000  # OpenCV's as well

LENS_KEYS = re.compile("model|type|lens|distortion|projection", re.IGNORECASE)
LENS_WORDS = {
    "fisheye": r"(opencv)?fisheye|(pinhole)?equi(distant)?|kannalabrandt[48]?|kb4",
    "polynomial": r"plumbbob|rationalpolynomial|(pinhole)?radtan|radialtangential|brown(conrady)?"
    r"|(full)?opencv|radial|rational|pinhole|perspective|none",
    "other": r"ds|doublesphere|e?ucm|omni(directional)?|mei|fov|atan|scaramuzza|ocam|division|ftheta"
    r"|thinprism(fisheye)?|fisheye624|cahvore?|stereographic|equirectangular",
}
"""In small letters and digits alone. A camera's product name may stand under any key but that of the
distortion: there only `other` is refused."""


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
            return ForeignFile(path, read_regular(path, MAX_BYTES).decode("utf-8-sig"))
        except FileNotFoundError:
            slash = ", with / between folders" if "\\" in str(path) else ""
            raise empty.error("there is no such file", remedy=f"check its name{slash}") from None
        except UnicodeDecodeError:
            raise empty.error("is not UTF-8 text") from None
        except OSError as fault:
            raise empty.error(f"cannot be read: {fault.strerror or fault}") from None

    def where(self, name: str = "") -> str:
        """The file, and the line of a name in it, preferably as a key.

        name: such as `cam0`, or `cam0.intrinsics` for the first `intrinsics` after `cam0`.
        """
        after, _, word = name.replace("/", ".").rpartition(".")
        first = self._find(name, 0)
        outer = self._find(after, 0) if first is None and after else 0
        found = self._find(word, outer) if first is None and outer is not None else first
        if not name or found is None:
            return str(self.path)
        line = self.text.count("\n", 0, found) + 1
        return f"{self.path}:{line}"

    def _find(self, word: str, start: int) -> int | None:
        alone = rf"(?<![\w.-]){re.escape(word)}(?![\w-])"
        as_key = rf"{alone}(?=[\"']?\s*[:=\]>]|\s+type_id)"
        matches = (re.compile(pattern).search(self.text, start) for pattern in (as_key, alone))
        return next((match.start() for match in matches if match), None)

    def error(self, what: str, name: str = "", remedy: str = "") -> CalibrationFileError:
        """An error about the file, or about what a name in it stands for."""
        return CalibrationFileError(
            f"{name[:100]}: {what[:300]}" if name else what[:300],  # a name may fill the file
            where=self.where(name),
            remedy=remedy[:800] or "give the file as that program wrote it",
        )

    def require(self, table: Mapping[str, Any], words: Iterable[str], key: str) -> None:
        """Raises CalibrationFileError unless the table of that name has all of the words."""
        for word in words:
            if word not in table:
                raise self.error(f"has no {word}", key, f"it has {', '.join(map(str, table))}")

    def numbers(self, value: Any, name: str, *counts: int) -> Array:
        """`value` as a flat array of one of these lengths."""
        if isinstance(value, dict):  # a matrix of OpenCV's
            value = value.get("data", value)
        try:
            array: Array = np.asarray(value, np.float64).ravel()
        except (TypeError, ValueError, OverflowError):
            raise self.error(f"holds what is not a number ({value!r:.60})", name) from None
        if len(array) not in counts:
            wanted = " or ".join(map(str, counts))
            raise self.error(f"holds {len(array)} numbers, not {wanted}", name)
        if not np.all(np.isfinite(array)):
            raise self.error("holds a number that is not finite", name)
        return array

    def matrix(self, value: Any, name: str) -> Array:
        """A of Eq. 1, (3, 3), from nine numbers row by row."""
        matrix = self.numbers(value, name, 9).reshape(3, 3)
        if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
            focal = f"{matrix[0, 0]:g} and {matrix[1, 1]:g}"
            raise self.error(f"has focal lengths {focal}, which must be positive", name)
        if matrix[1, 0] != 0.0 or not np.array_equal(matrix[2], [0.0, 0.0, 1.0]):
            what = "is not a camera matrix, which has zeros below its diagonal and 1 at its end"
            remedy = "check that it is not transposed, nor a projection of three by four"
            raise self.error(what, name, remedy)
        return matrix

    def pinhole_matrix(self, value: Any, name: str) -> Array:
        """A of Eq. 1 from fx, fy, cx, cy."""
        fx, fy, cx, cy = self.numbers(value, name, 4)
        return self.matrix([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], name)

    def lens(self, value: Any, name: str, around: Mapping[str, Any] | None = None) -> Lens:
        """The lens with OpenCV's coefficients in OpenCV's order, 0 to 14 of them.

        around: what stands around them, whose words decide whether it is OpenCV's fisheye.
        """
        given = self.numbers(value, name, 0, 1, 2, 3, 4, 5, 8, 12, 14)
        around, owner = around or {}, name.rpartition(".")[0]
        self._refuse_cropped(around, owner)
        if self._is_fisheye(around, owner):
            if np.any(given[4:]):
                raise self.error(f"holds {len(given)} numbers, a fisheye has 4", name)
            return Fisheye(*given[:4].tolist())
        try:
            return lens_from_opencv(np.pad(given, (0, max(0, 5 - len(given)))))
        except ValueError as error:
            raise self.error(str(error), name, "calibrate it with a supported lens") from None

    def _refuse_cropped(self, around: Mapping[str, Any], owner: str) -> None:
        """Of ROS's CameraInfo the matrix is that of the full image, whatever was read out of it."""
        wrong = [key for key in ("binning_x", "binning_y") if around.get(key, 1) not in (0, 1)]
        roi = around.get("roi")
        if isinstance(roi, dict) and (roi.get("x_offset") or roi.get("y_offset")):
            wrong.append("roi")
        if wrong:
            what = "of pictures that are binned or cropped, but ROS gives the full picture's matrix"
            remedy = "give full pictures; or the matrix and size of these, without binning and roi"
            raise self.error(what, f"{owner}.{wrong[0]}".strip("."), remedy)

    def _is_fisheye(self, around: Mapping[str, Any], owner: str) -> bool:
        words: dict[bool, str] = {}  # a key that says whether it is one
        for key, value in around.items():
            word, name = re.sub(r"[^a-z0-9]", "", str(value).lower()), f"{owner}.{key}".strip(".")
            if "fisheye" in key.lower() and word in ("true", "1", "yes", "false", "0", "no"):
                words[word in ("true", "1", "yes")] = name
            elif LENS_KEYS.search(key) and isinstance(value, str) and word:
                kinds = [kind for kind, some in LENS_WORDS.items() if re.fullmatch(some, word)]
                is_model = re.search("distortion_?(model|type)", key, re.IGNORECASE)
                if "fisheye" in kinds or (is_model and "polynomial" in kinds):
                    words["fisheye" in kinds] = name
                if "other" in kinds or (is_model and not kinds):
                    remedy = "use plumb_bob (radtan), rational_polynomial or equidistant"
                    raise self.error(f"{value!r} is a lens that is not supported", name, remedy)
        if len(words) > 1:
            what = f"contradicts {words[True]}: is the lens a fisheye or not?"
            raise self.error(what, words[False], "leave out the one that is wrong")
        return True in words

    def size(self, value: Any, name: str) -> tuple[int, int]:
        """Width and height of an image, px."""
        width, height = self.numbers(value, name, 2)
        if width != int(width) or height != int(height) or width < 1 or height < 1:
            raise self.error(f"is not the size of an image ({width:g} x {height:g})", name)
        return int(width), int(height)

    def pose(self, rotation: Any, translation: Any, *names: str) -> RigidTransform:
        """A pose from a rotation (vector, or matrix row by row) and a translation, and their names.

        A matrix is replaced by the nearest rotation.
        """
        given = self.numbers(rotation, names[0], 3, 9)
        shift = self.numbers(translation, names[-1], 3)
        if len(given) == 3:
            return RigidTransform.from_rotation_vector(given, shift)
        matrix = given.reshape(3, 3)
        # Four digits suffice; a milliradian is a millimetre at a metre.
        deviation = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if deviation > 1e-3:
            what = f"is not a rotation: R times its transpose differs from 1 by {deviation:.2g}"
            raise self.error(what, names[0])
        if np.linalg.det(matrix) < 0.0:
            what = "is a reflection (its determinant is -1), which no camera's pose is"
            remedy = "check whether an axis, such as y or z, has the opposite direction"
            raise self.error(what, names[0], remedy)
        return RigidTransform.from_matrix(np.column_stack([matrix, shift]))


def read_document(file: ForeignFile) -> Any:
    """Parse YAML in any program's dialect, JSON, or the XML of OpenCV's FileStorage to plain data.

    Raises CalibrationFileError, with the line, if it is none of them.
    """
    text = file.text.lstrip()
    try:
        if text.startswith("<"):
            return _convert_xml(ElementTree.fromstring(text))
        if text.startswith("{"):
            with suppress(ValueError):
                return json.loads(text)
        document = parse_yaml(file.text, MAX_VALUES, foreign=True)
    except YamlError as error:
        place, what = error.problem.place, error.problem.text
    except ElementTree.ParseError as error:
        place, what = Place(error.position[0], error.position[1] + 1), f"is not XML: {error}"
    except RecursionError:
        raise file.error("is nested too deep") from None
    else:
        if not document.problems:
            return document.data
        first = document.problems[0]
        place, what = first.place, f"{first.path}: {first.text}"
    where, remedy = f"{file.path}:{place.line}", "give the file as that program wrote it"
    raise CalibrationFileError(what, where=where, remedy=remedy)


def _convert_xml(element: ElementTree.Element) -> Any:
    parts = list(element)
    if parts and all(part.tag == "_" for part in parts):
        return [_convert_xml(part) for part in parts]
    if parts:
        return {part.tag: _convert_xml(part) for part in parts}
    text = (element.text or "").strip()
    values = [parse_scalar(word) for word in text.split()]
    if not all(isinstance(value, int | float) for value in values):
        return text.strip('"')
    return values[0] if len(values) == 1 else values
