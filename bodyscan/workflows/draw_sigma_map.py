"""Draw a stored calibration's sigma over the scan volume, as a picture beside it."""

from __future__ import annotations

from pathlib import Path

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_bytes
from bodyscan.registration.storage import MAP_NAME, load_calibration
from bodyscan.report.sigma_map import draw_sigma_map as draw


def draw_sigma_map(calibration: Path, path: Path | None = None) -> Path:
    """Draw the map and return the picture's path, beside the calibration if no path is given.

    Raises BadInput for a path that does not end in .png and where no sigma is known,
    CalibrationFileError.
    """
    path = path or (calibration if calibration.is_dir() else calibration.parent) / MAP_NAME
    if path.suffix.lower() != ".png":
        raise BadInput("the map is drawn as PNG", where=str(path), remedy="name it .png")
    write_bytes(path, draw(load_calibration(calibration)))
    return path
