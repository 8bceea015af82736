"""A calibrated rig as files for other programs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from bodyscan.calibration.pair import PairCalibration
from bodyscan.calibration.projector_camera import FittedProjector, fit_projector
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
    poses = calibration.rig_from_camera
    cameras = {name: (pair.camera, poses[name]) for name, pair in calibration.pairs.items()}
    projectors = fit_projectors(calibration)
    written = [_write(one, cameras, projectors.value, folder) for one in chosen]
    notes = [note for one in written for note in one.notes]
    return Outcome([one.value for one in written], (*projectors.notes, *notes))


def fit_projectors(calibration: RigCalibration) -> Outcome[RigCameras]:
    """Fit a camera model to every projector with a centre and a lens; the notes give the misfits to
    the measured light sheets."""
    cameras: dict[str, tuple[Camera, RigidTransform]] = {}
    notes: list[str] = []
    for name, pair in calibration.pairs.items():
        if pair.sheets is None:
            continue
        label = projector_name(name)
        try:
            if label in calibration.pairs:
                raise BadInput(f"another pair is named {label} already", remedy="rename that pair")
            fitted = fit_projector(pair.camera, pair.sheets, pair.crossing)
        except BadInput as error:
            notes.append(f"{name}: its projector is left out: {error}")
            continue
        rig_from_camera = calibration.rig_from_camera[name]
        cameras[label] = fitted.camera, rig_from_camera @ fitted.projector_from_camera.inverse()
        notes.append(f"{name}: {_describe_projector(pair, fitted)}")
    written = [name for name in calibration.pairs if projector_name(name) in cameras]
    return Outcome(cameras, (*notes, *_note_first_codes(calibration.rig, written)))


def _note_first_codes(rig: Rig, written: Sequence[str]) -> Iterator[str]:
    """Note that another first code would shift the images: nothing in a scan shows it."""
    pairs_with: dict[str, list[str]] = {}
    for name in written:
        code = rig.pair(name).projector
        for direction in code.directions if code else ():
            if getattr(direction, "first_code", None) != 0:
                continue
            codes = 1 << direction.image_counts[PATTERN]
            middle = (codes - direction.stripes) // 2
            if middle > 1:
                note = (
                    f"the first of {direction.stripes} {direction.direction} stripes is taken to "
                    f"have code 0 of {codes}; if it has another, such as {middle} where they lie in "
                    "the middle, give `first_code` in the rig file: the written projector is off by "
                    "as many pixels"
                )
                pairs_with.setdefault(note, []).append(name)
    for note, names in pairs_with.items():
        yield f"{', '.join(names)}: {note}"


def _write(
    form: RigFormat, cameras: RigCameras, projectors: RigCameras, folder: Path
) -> Outcome[Path]:
    """Write one format, without the projectors whose lenses it cannot express."""
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


def _describe_projector(pair: PairCalibration, fitted: FittedProjector) -> str:
    assert pair.sheets is not None
    text = f"its projector is written as a camera, {projector_name(pair.name)}"
    if fitted.predicted_px:
        text += (
            f", {fitted.misfit_px:.2g} of its pixels RMS off its light sheets (noise explains "
            f"{fitted.predicted_px:.2g})"
        )
    if pair.crossing is None:
        across, along = "columns", "rows"
        if pair.sheets.direction != "vertical":
            across, along = along, across
        text += f"; its {across} are measured, its {along} are not: square pixels are written"
    return text
