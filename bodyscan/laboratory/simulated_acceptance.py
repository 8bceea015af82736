"""The acceptance test's artefacts, put into a simulated rig and measured pose by pose."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bodyscan.arrays import Array
from bodyscan.captures.folder import open_scan
from bodyscan.evaluation.acceptance import AcceptanceFile, Readings
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import Volume
from bodyscan.simulation import artefact
from bodyscan.workflows.accept_rig import read_plates, read_spheres

SPHERES = (
    ("middle, across", (0.0, 0.0, 0.45), (0.0, 1.0, 0.0)),
    ("middle, upright", (0.0, 0.0, 0.5), (0.0, 0.0, 1.0)),
    ("low, front", (0.25, 0.1, 0.25), (0.6, 0.8, 0.0)),
    ("high, left", (0.0, 0.25, 0.65), (1.0, 0.0, 0.0)),
    ("through the middle", (0.0, -0.1, 0.4), (0.5, 0.5, 0.7)),
)
"""Name; middle as shares of the volume's radius (x, y) and height (z); direction of the bar."""
PLATES = (
    ("middle, facing front", (0.0, 0.0, 0.45), (1.0, 0.0, 0.0)),
    ("left, facing left and back", (-0.1, 0.25, 0.5), (-0.8, 0.6, 0.0)),
    ("low, tilted up", (0.2, -0.1, 0.3), (0.7, -0.4, 0.5)),
)
"""Name, middle, and the direction the plate faces."""


def simulate_readings(
    calibration: RigCalibration,
    workspace: Path,
    file: AcceptanceFile,
    repeats: int,
    max_poses: int | None,
    progress: Progress = silent,
) -> Readings:
    """Measure `repeats` shots of the spheres and one of the plate in each of the first `max_poses`.

    The images of a pose are measured and deleted before the next one's are made.
    """
    world = artefact.open_workspace(workspace)
    centres, volume = np.array(file.spheres.centres_mm), calibration.rig.volume
    balls = artefact.sphere_surfaces(centres, file.spheres.radius_mm)
    flat = artefact.plate_surface(*file.plate.size_mm)
    of_spheres = [
        (name, at, balls, repeats, read_spheres)
        for name, at in spheres_at(volume, centres)[:max_poses]
    ]
    of_plates = [(name, at, flat, 1, read_plates) for name, at in plates_at(volume)[:max_poses]]
    total = Readings()
    for number, (name, at, surfaces, shots, read) in enumerate([*of_spheres, *of_plates]):
        with TemporaryDirectory(prefix="bodyscan-") as folder:
            out = Path(folder) / f"pose-{number + 1}"
            taken = artefact.capture_artefact(
                world,
                surfaces,
                at,
                out,
                shots=shots,
                number=number,
                progress=progress,
            )
            total += read(calibration, open_scan(calibration.rig, taken), name, file, progress)
    return total


def spheres_at(volume: Volume, centres: Array) -> list[tuple[str, RigidTransform]]:
    """List names and `rig_from_artefact` of a bar of spheres with centres (N, 3)."""
    middle = centres.mean(axis=0)
    return [
        (name, _pose_in_volume(volume, share, direction, middle))
        for name, share, direction in SPHERES
    ]


def plates_at(volume: Volume) -> list[tuple[str, RigidTransform]]:
    """List names and `rig_from_artefact` of a plate in the plane x = 0 about the origin."""
    return [
        (name, _pose_in_volume(volume, share, direction, np.zeros(3)))
        for name, share, direction in PLATES
    ]


def _pose_in_volume(
    volume: Volume,
    share: tuple[float, float, float],
    direction: tuple[float, float, float],
    middle: Array,
) -> RigidTransform:
    """Put an artefact's `middle` at `share` of the volume, x along `direction`, y level."""
    x = np.array(direction) / np.linalg.norm(direction)
    level = np.cross([0.0, 0.0, 1.0], x)
    y = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-9 else np.array([0.0, 1, 0])
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)
    height = volume.bottom_mm + share[2] * (volume.top_mm - volume.bottom_mm)
    target = np.array([share[0] * volume.radius_mm, share[1] * volume.radius_mm, height])
    return RigidTransform(rotation, target - rotation @ middle)
