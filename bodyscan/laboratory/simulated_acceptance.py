"""The acceptance test's artefacts, simulated in a simulated rig and measured place by place."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bodyscan.captures.folder import open_scan
from bodyscan.evaluation.acceptance_file import AcceptanceFile
from bodyscan.evaluation.acceptance_readings import Readings
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.simulation import artefact
from bodyscan.simulation.acceptance_places import plates_at, spheres_at
from bodyscan.workflows.accept import read_plates, read_spheres


def simulate_readings(
    calibration: RigCalibration,
    workspace: Path,
    file: AcceptanceFile,
    repeats: int,
    places: int | None,
    progress: Progress = silent,
) -> Readings:
    """`repeats` shots of the spheres and one of the plate at each of the first `places` places.

    The images of a place are measured and thrown away before the next one's are made.
    """
    world = artefact.open_workspace(workspace)
    centres, volume = np.array(file.spheres.centres_mm), calibration.rig.volume
    balls = artefact.sphere_surfaces(centres, file.spheres.radius_mm)
    flat = artefact.plate_surface(*file.plate.size_mm)
    of_spheres = [
        (name, at, balls, repeats, read_spheres)
        for name, at in spheres_at(volume, centres)[:places]
    ]
    of_plates = [(name, at, flat, 1, read_plates) for name, at in plates_at(volume)[:places]]
    total = Readings()
    for number, (name, at, surfaces, shots, read) in enumerate([*of_spheres, *of_plates]):
        with TemporaryDirectory(prefix="bodyscan-") as folder:
            place = Path(folder) / f"place-{number + 1}"
            taken = artefact.capture_artefact(
                world, surfaces, at, place, shots=shots, number=number, progress=progress
            )
            total += read(calibration, open_scan(calibration.rig, taken), name, file, progress)
    return total
