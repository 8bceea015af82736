"""A calibrated rig as files for other programs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from bodyscan.calibration.fitted_projector import FittedProjector, fit_projector
from bodyscan.calibration.pair import PairCalibration
from bodyscan.errors import BadInput
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.rig_format import RIG_FORMATS, RigCameras, RigFormat, projector_name
from bodyscan.outcome import Outcome
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import Rig
from bodyscan.stripes.codes.gray import PATTERN


def export_rig(
    calibration: RigCalibration, folder: Path, formats: Sequence[str]
) -> Outcome[list[Path]]:
    """Write the rig in each format: its cameras, and its projectors as further cameras.

    A projector that has no model with a lens, or whose lens a format cannot express, is left out
    with a note that says why. Raises BadInput for an unknown format, before anything is written,
    and for a camera's lens that a format cannot express.
    """
    chosen = [RIG_FORMATS.find(name.strip().lower()) for name in dict.fromkeys(formats)]
    cameras = cameras_of(calibration)
    projectors = projectors_of(calibration)
    written = [_write(one, cameras, projectors.value, folder) for one in chosen]
    notes = [note for one in written for note in one.notes]
    return Outcome([one.value for one in written], (*projectors.notes, *notes))


def cameras_of(calibration: RigCalibration) -> RigCameras:
    """Camera and pose of every pair of a calibration."""
    return {
        name: (pair.camera, calibration.rig_from_camera[name])
        for name, pair in calibration.pairs.items()
    }


def projectors_of(calibration: RigCalibration) -> Outcome[RigCameras]:
    """Every projector with a centre and a lens as a camera, and how far that is from the sheets
    that were measured."""
    found: dict[str, tuple[Camera, RigidTransform]] = {}
    notes: list[str] = []
    for name, pair in calibration.pairs.items():
        if pair.sheets is None:
            continue
        own = projector_name(name)
        try:
            if own in calibration.pairs:
                raise BadInput(f"a pair is called {own}, as it would be", remedy="rename that pair")
            fitted = fit_projector(pair.camera, pair.sheets, pair.crossing)
        except BadInput as error:
            notes.append(f"{name}: its projector is left out: {error}")
            continue
        rig_from_camera = calibration.rig_from_camera[name]
        found[own] = fitted.camera, rig_from_camera @ fitted.projector_from_camera.inverse()
        notes.append(f"{name}: {_described(pair, fitted)}")
    written = [name for name in calibration.pairs if projector_name(name) in found]
    return Outcome(found, (*notes, *_first_codes(calibration.rig, written)))


def _first_codes(rig: Rig, written: Sequence[str]) -> Iterator[str]:
    """A note that another first code would shift the images: nothing in a scan shows it."""
    alike: dict[str, list[str]] = {}
    for name in written:
        code = rig.pair(name).projector
        for way in code.directions if code else ():
            if getattr(way, "first_code", None) != 0:
                continue
            codes = 1 << way.image_counts[PATTERN]
            middle = (codes - way.stripes) // 2
            if middle > 1:
                said = (
                    f"the first of {way.stripes} {way.direction} stripes is taken to have code 0 of "
                    f"{codes}; if it has another, such as {middle} where they lie in the middle, give "
                    "`first_code` in the rig file: the written projector is off by as many pixels"
                )
                alike.setdefault(said, []).append(name)
    for said, names in alike.items():
        yield f"{', '.join(names)}: {said}"


def _write(
    form: RigFormat, cameras: RigCameras, projectors: RigCameras, folder: Path
) -> Outcome[Path]:
    path = folder / form.path
    kept = dict(projectors)
    notes: list[str] = []
    while True:
        try:
            return Outcome(form.write({**cameras, **kept}, path), tuple(notes))
        except BadInput as error:
            unfit = [name for name in kept if error.where == f"pair {name}"]
            if not unfit:
                raise
            notes += [f"{name} is not in {form.path}: {error.what}" for name in unfit]
            for name in unfit:
                del kept[name]


def _described(pair: PairCalibration, fitted: FittedProjector) -> str:
    assert pair.sheets is not None
    said = f"its projector is written as a camera, {projector_name(pair.name)}"
    if fitted.predicted_px:
        said += (
            f", {fitted.misfit_px:.2g} of its pixels RMS off its sheets of light (noise explains "
            f"{fitted.predicted_px:.2g})"
        )
    if pair.crossing is None:
        known, guessed = (
            ("columns", "rows") if pair.sheets.direction == "vertical" else ("rows", "columns")
        )
        said += f"; its {known} are measured, its {guessed} are not: square pixels are written"
    return said
