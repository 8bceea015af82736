"""The public Python interface: calibrate a rig, scan people, measure and export the results.

    import bodyscan

    calibration = bodyscan.calibrate_rig("rig.yaml")
    bodyscan.save_calibration(calibration, "calibration")

    person = bodyscan.scan("captures/person", calibration)
    print(person.verdict)
    print(bodyscan.measure(person).stature_mm)

    kept = bodyscan.save_scan(person, "person-model", calibration="calibration")
    bodyscan.export_scan(kept, "person-export")

Lengths are millimetres. Points are in the rig frame (origin on the floor, x the way the subject
faces, y to the subject's left, z up) unless a name says otherwise. Every error is a
`BodyscanError`: `BadInput` where the caller can mend something, `FailedWork` where good input gave
no result; both say what went wrong, where, and what to do. `progress` is any function of a stage's
name, the number of steps done and their total.

The names in `bodyscan.__all__` are stable, as docs/api.md says. Any other module (`bodyscan.geometry`,
say) may be imported too, but may change at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import bodyscan.api  # annotations name its types, which `get_type_hints` then imports
from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, silent
from bodyscan.settings import (
    AlignmentSettings,
    ExportSettings,
    FusionSettings,
    MeshSettings,
    ScanSettings,
)
from bodyscan.verdict import Verdict

if TYPE_CHECKING:
    from bodyscan.arrays import Bytes as Bytes
    from bodyscan.evaluation.surface import Comparison
    from bodyscan.fusion.storage import Scan, StoredScan
    from bodyscan.measurement.measurements import Measurements
    from bodyscan.mesh.body import BodyCloud, BodyMesh
    from bodyscan.reconstruction.range_image import RangeImage
    from bodyscan.registration.rig_calibration import RigCalibration
    from bodyscan.rig.rig import Rig

AnyPath: TypeAlias = str | PathLike[str]

_MODULE_OF = {
    "BodyCloud": "bodyscan.mesh.body",
    "BodyMesh": "bodyscan.mesh.body",
    "Comparison": "bodyscan.evaluation.surface",
    "Bytes": "bodyscan.arrays",
    "Measurements": "bodyscan.measurement.measurements",
    "RangeImage": "bodyscan.reconstruction.range_image",
    "Rig": "bodyscan.rig.rig",
    "RigCalibration": "bodyscan.registration.rig_calibration",
    "Scan": "bodyscan.fusion.storage",
    "StoredScan": "bodyscan.fusion.storage",
}
"""Where each type lives: it is imported on first use, since importing it takes time."""

__all__ = [
    "AlignmentSettings",
    "BadInput",
    "BodyCloud",
    "BodyMesh",
    "BodyscanError",
    "Comparison",
    "ExportSettings",
    "FailedWork",
    "FusionSettings",
    "Measurements",
    "MeshSettings",
    "Outcome",
    "RangeImage",
    "Rig",
    "RigCalibration",
    "Scan",
    "ScanSettings",
    "StoredScan",
    "Verdict",
    "calibrate_rig",
    "compare",
    "export_scan",
    "import_calibration",
    "load_calibration",
    "load_rig",
    "load_scan",
    "measure",
    "put_image",
    "save_calibration",
    "save_scan",
    "scan",
    "triangulate",
    "write_report",
]


def load_rig(path: AnyPath) -> bodyscan.Rig:
    """Read a rig file. Raises RigFileError with every problem, by line and column.

    >>> rig = load_rig("rigs/three-pole-12.yaml")
    >>> len(rig.pairs), rig.pairs[0].name, rig.volume.radius_mm
    (12, 'p1-1', 700.0)
    """
    from bodyscan.rig.rig import load_rig as load

    return load(Path(path))


def calibrate_rig(
    rig_file: AnyPath | bodyscan.Rig, *, folder: AnyPath | None = None, progress: Progress = silent
) -> bodyscan.RigCalibration:
    """Calibrate every pair of a rig and its pose, from the board images that the rig file names.

    rig_file: a path, or a `Rig` from `load_rig`, changed or not.
    folder: what a `Rig`'s paths are relative to; the current folder if None. Ignored for a path,
        whose own folder is used.

    The result's `notes` and `failed` say what was left out and why. Raises RigFileError and
    CaptureError; FailedWork if no pair can be calibrated or nothing ties the pairs together.
    """
    from bodyscan.captures.folder import open_captures
    from bodyscan.workflows.calibrate_rig import calibrate_rig as calibrate

    if isinstance(rig_file, str | PathLike):
        rig, path = load_rig(rig_file), Path(rig_file)
    else:
        rig, path = rig_file, Path(folder or "") / "rig.yaml"
    return calibrate(rig, open_captures(rig, path), progress, folder=path.parent)


def import_calibration(
    rig_file: AnyPath, *, sigma_px: float | None = None
) -> bodyscan.RigCalibration:
    """Import other programs' calibrations, from the files that the rig file names as `known`.

    sigma_px: sigma of their pixels, px, overriding the rig file's; if neither gives one, the
        accuracy is unknown.

    Raises RigFileError; CalibrationFileError if no pair is left.
    """
    from bodyscan.workflows.import_rig import import_rig

    return import_rig(load_rig(rig_file), Path(rig_file).parent, sigma_px)


def put_image(
    inbox: AnyPath,
    calibration: bodyscan.RigCalibration,
    scan: str,
    pair: str,
    frame: str,
    image: bodyscan.api.Bytes,
    *,
    shot: str = "s01",
) -> Path:
    """Write an image held in memory into the inbox of `bodyscan watch`; return the file's path.

    scan: name of the scan's folder, which becomes the job's name.
    image: (height, width) uint8 or uint16.

    Raises BadInput for a pair or a frame that the rig does not have.
    """
    from bodyscan.jobs.watching import put_image as put

    return put(Path(inbox), calibration.rig, scan, pair, frame, image, shot=shot)


def save_calibration(calibration: bodyscan.RigCalibration, folder: AnyPath) -> Path:
    """Write calibration.json and its arrays into `folder`; return the path of the JSON."""
    from bodyscan.registration.storage import save_calibration as save

    return save(calibration, Path(folder))


def load_calibration(path: AnyPath) -> bodyscan.RigCalibration:
    """Read what `save_calibration` or `bodyscan calibrate-rig` wrote, exact to the last bit.

    Raises CalibrationFileError:

    >>> try:
    ...     load_calibration("nowhere")
    ... except BadInput as error:
    ...     print(error)
    nowhere: there is no such file
      give the folder that `bodyscan calibrate-rig` wrote
    """
    from bodyscan.registration.storage import load_calibration as load

    return load(Path(path))


def triangulate(
    folder: AnyPath, calibration: bodyscan.RigCalibration, *, progress: Progress = silent
) -> Outcome[list[bodyscan.RangeImage]]:
    """Each pair's range image of a scan, in its camera's frame: what lies in the rig's `volume` and a
    little around it.

    Pairs that gave nothing are in the outcome's `failures` or `notes`, with the reason. Raises
    CaptureError; ScanFailed if no pair gave anything.
    """
    from bodyscan.captures.folder import open_scan
    from bodyscan.workflows.range_images import reconstruct_range_images

    captures = open_scan(calibration.rig, Path(folder))
    return reconstruct_range_images(calibration, captures, progress)


def scan(
    folder: AnyPath,
    calibration: bodyscan.RigCalibration,
    settings: ScanSettings = ScanSettings(),
    *,
    empty: AnyPath | None = None,
    progress: Progress = silent,
) -> bodyscan.Scan:
    """Fuse one person's captures into a cloud and a closed mesh, with a verdict on them.

    empty: captures of the rig with nobody in it; the surfaces they show are cut away.

    Raises CaptureError; ScanFailed if there is no body.

    >>> ScanSettings(fusion=FusionSettings(points=200_000)).mesh.depth
    9
    """
    from bodyscan.captures.folder import open_scan
    from bodyscan.workflows.scan_person import scan_person

    captures = open_scan(calibration.rig, Path(folder))
    nobody = None if empty is None else open_scan(calibration.rig, Path(empty))
    return scan_person(calibration, captures, settings, progress, empty=nobody)


def save_scan(
    scan: bodyscan.Scan,
    folder: AnyPath,
    *,
    calibration: AnyPath,
    subject: str | None = None,
    when: datetime | None = None,
) -> bodyscan.StoredScan:
    """Write the body model and its description (scan.json) into `folder`; return it as read back.

    calibration: path of the calibration that the scan was made with; scan.json has its hash.
    subject: pseudonym by which `bodyscan forget` finds everything made of a person.
    """
    from bodyscan.fusion.storage import Origin, save_body, save_facts
    from bodyscan.registration.storage import calibration_id, load_calibration

    stored, written = Path(calibration), Path(folder)
    axes = load_calibration(stored).axes
    origin = Origin(calibration_id(stored), subject, when, axes=axes)
    with save_body(scan, written) as digests:
        save_facts(scan, written, origin, digests)
    return load_scan(folder)


def load_scan(folder: AnyPath) -> bodyscan.StoredScan:
    """Read what `save_scan` or `bodyscan scan` wrote. Raises ResultError if missing or damaged."""
    from bodyscan.fusion.storage import load_scan as load

    return load(Path(folder))


def measure(
    body: bodyscan.Scan | bodyscan.StoredScan | bodyscan.BodyMesh,
    heights_mm: Sequence[float] | None = None,
    *,
    named: bool = False,
) -> bodyscan.Measurements:
    """Stature, volume, area and girths of horizontal slices, each with the share measured.

    heights_mm: heights of the slices above the floor; every 100 mm if None.
    named: lay a body over the scan too, which takes seconds: `measures["waist girth"].mm` and
        `.interval_mm`, and the landmarks in `named.landmarks`.

    Raises BadInput for a height at which there is no body, or if the body does not stand.
    """
    from bodyscan.measurement.measurements import measure as measure_mesh
    from bodyscan.mesh.body import BodyMesh

    return measure_mesh(body if isinstance(body, BodyMesh) else body.mesh, heights_mm, named=named)


def compare(
    body: bodyscan.Scan | bodyscan.StoredScan | bodyscan.BodyMesh,
    other: AnyPath | bodyscan.Scan | bodyscan.StoredScan | bodyscan.BodyMesh,
    *,
    fit: bool = False,
) -> bodyscan.Comparison:
    """Signed distances (mm, outside positive) of what a scan measured from another surface.

    other: a scan, its folder, or the path of a mesh (PLY, OBJ, STL) in mm, z up.
    fit: fit the scan to the other first. Raises BadInput if `other` is of no such subject.
    """
    from bodyscan.evaluation.surface import compare_surfaces
    from bodyscan.mesh.body import BodyMesh

    mesh = body if isinstance(body, BodyMesh) else body.mesh
    if isinstance(other, str | PathLike):
        return compare_surfaces(mesh, Path(other))[fit]
    return compare_surfaces(mesh, other if isinstance(other, BodyMesh) else other.mesh)[fit]


def export_scan(
    stored: bodyscan.StoredScan,
    folder: AnyPath,
    settings: ExportSettings = ExportSettings(),
    *,
    frame: Literal["rig", "body"] = "rig",
    up: Literal["z", "y"] = "z",
) -> list[Path]:
    """Write a scan for other programs, each file with a JSON beside it; return the paths.

    frame: the rig's, or the body's own (origin beneath the body, x the way it faces).
    up: the axis that points up in PLY, OBJ and STL; in GLB it is y.

    Raises BadInput for an unknown format; FailedWork if a face is to go and no neck is found.

    >>> ExportSettings().formats
    ('ply', 'obj', 'stl', 'glb')
    """
    from bodyscan.export.scan import export_scan as export

    return export(
        stored,
        Path(folder),
        settings.formats,
        settings.versions,
        deface=settings.deface,
        texture_px=settings.texture_px,
        frame=frame,
        up=up,
    )


def write_report(result: AnyPath, path: AnyPath | None = None) -> Verdict:
    """Write one HTML report on a stored calibration or scan, and return its verdict.

    path: where to write it; report.html inside `result` if None.

    Raises BadInput for anything that is neither a calibration nor a scan.
    """
    from bodyscan.report.result_page import write_report as write

    return write(Path(result), None if path is None else Path(path))[1].verdict


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name not in _MODULE_OF:
            raise AttributeError(f"module 'bodyscan' has no attribute {name!r}")
        return getattr(import_module(_MODULE_OF[name]), name)
