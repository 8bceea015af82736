"""A calibration's report: how well each pair and the whole rig are known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path

import numpy as np

from bodyscan.calibration.camera import LensTrial
from bodyscan.calibration.lens_choice import MIN_CLUSTERS
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import FILE_NAME, calibration_id, load_calibration
from bodyscan.report import calibration_charts as draw
from bodyscan.report import calibration_verdict as limits
from bodyscan.report import charts
from bodyscan.report.calibration_verdict import PairFigures, figures_of, grade_calibration
from bodyscan.report.page import (
    Block,
    Column,
    Lines,
    Page,
    Picture,
    Section,
    Table,
    Viewer,
    is_synthetic,
    sections_of,
)
from bodyscan.report.rig_model import rig_model
from bodyscan.report.sigma_map import draw_sigma_map, why_no_sigma

PAIR_COLUMNS = (
    Column("pair"),
    Column(
        "corners",
        "px RMS",
        "distance of the boards' corners from where camera and pose put them.",
        limits.CORNERS_RMS_PX,
    ),
    Column("poses", "", "views of a board that were used.", limits.POSES, True, 0),
    Column(
        "covered",
        "% of picture",
        "by the boards' corners together; beyond, the lens is extrapolated.",
        limits.COVERED_PERCENT,
        True,
        0,
    ),
    Column(
        "sheets",
        "mm RMS",
        "distance of stripe boundaries on the boards from their sheet of light.",
        limits.SHEETS_RMS_MM,
    ),
    Column(
        "held out",
        "mm mean",
        "distance of measured points from boards that the light was not fitted to; outliers "
        "capped.",
        limits.HELD_OUT_MM,
    ),
    Column("striped", "", "boards on which stripes were decoded.", limits.STRIPE_SHOTS, True, 0),
    Column(
        "stripes",
        "% known",
        "boundaries between stripes that have a sheet, of those projected; the others fell "
        "beyond the boards.",
        limits.STRIPES_PERCENT,
        True,
        0,
    ),
    Column(
        "sigma",
        "mm",
        "of the camera's position in the rig frame, all axes together, from the covariance of the "
        "joint solve.",
        limits.SIGMA_MM,
    ),
    Column("light", "", "model of the light sheets, chosen by held-out boards."),
    Column("lens", "", "chosen by held-out boards, or named in the rig file; see below."),
)


def calibration_page(folder: Path) -> Page:
    """The report of the calibration in `folder`. Raises CalibrationFileError."""
    calibration = load_calibration(folder)
    shots = len({shot for shot, _ in calibration.rig_from_board})
    return Page(
        f"Calibration of rig {calibration.rig.name}",
        grade_calibration(calibration),
        is_synthetic(folder),
        (
            ("pairs", f"{len(calibration.pairs)} of {len(calibration.rig.pairs)}"),
            ("shots of boards", str(shots)),
            ("calibration", calibration_id(folder)[:12]),
            ("made by", str(json.loads((folder / FILE_NAME).read_text("utf-8"))["software"])),
        ),
        calibration.axes,
        sections_of(
            {
                "The rig": lambda: _rig(calibration),
                "Pairs": lambda: _pairs(figures_of(calibration), calibration),
                "Advice": lambda: _advice(calibration),
                "Boards in the pictures": lambda: _boards(calibration),
                "Light sheets": lambda: _planes(calibration),
                "Who shares boards with whom": lambda: _view_graph(calibration),
                "How well each place is known": lambda: _sigma(calibration),
                "Notes": lambda: _notes(calibration),
            }
        ),
    )


def _rig(calibration: RigCalibration) -> Section:
    model, times = rig_model(calibration)
    source = "the joint solve knows it"
    if calibration.is_import:
        source = "the import says (that of 1 px where it says nothing)"
    ellipsoids = (
        f"Ellipsoids: one sigma of each camera's position in the rig frame as {source}, enlarged "
        f"{times:,.0f} times. "
        if len(calibration.pairs) > 1
        else ""
    )
    return Section(
        "The rig",
        [
            Viewer(
                "Cameras in the rig frame",
                f"Pyramids: cameras and what they see. {ellipsoids}"
                "Grey: boards, and the scan volume. Red, green and blue: the rig's "
                "axes x, y and z.",
                model,
            )
        ],
    )


def _pairs(figures: list[PairFigures], calibration: RigCalibration) -> Section:
    rows = tuple(
        (
            *astuple(one),
            calibration.pairs[one.name].quality.light_model,
            calibration.pairs[one.name].camera.lens.kind,
        )
        for one in figures
    )
    return Section("Pairs", [Table(PAIR_COLUMNS, rows), Lines(tuple(_lens_lines(calibration)))])


def _lens_lines(calibration: RigCalibration) -> Iterator[str]:
    """How each lens that was tried did on boards to which it was not fitted."""
    for name, pair in calibration.pairs.items():
        tried = pair.quality.lenses
        if not tried:
            yield (
                f"{name}: lens {pair.camera.lens.kind}; none was tried on held-out boards (it was "
                f"given, or boards stood in fewer than {MIN_CLUSTERS} places of the picture)"
            )
            continue
        figures = "; ".join(_lens_figure(one) for one in tried)
        yield f"{name}: lens {pair.camera.lens.kind}; held-out corners, RMS: {figures}"


def _lens_figure(tried: LensTrial) -> str:
    gain = "" if tried.gain is None else f" ({_better(tried.gain)} better)"
    return f"{tried.kind} {tried.rms_px:.3f} px{gain}"


def _choice_lines(calibration: RigCalibration) -> Iterator[str]:
    """What was chosen and rejected on held-out boards, and by how much."""
    for name, pair in calibration.pairs.items():
        quality = pair.quality
        light = [
            f"{one.model} ({_better(one.gain)})" for one in quality.held_out if one.gain is not None
        ]
        if light:
            yield f"{name}: light {quality.light_model}; tried: {'; '.join(light)}"
        if quality.refinement:
            yield f"{name}: solved by {quality.refinement}"
        for board, mm in quality.bent_mm.items():
            yield f"{name}: board {board} is bent by {mm:.3f} mm, lowest to highest corner"


def _better(gain: float) -> str:
    return f"{gain:+z.1f} standard errors"


def _advice(calibration: RigCalibration) -> Section:
    why = (
        "another program calibrated the rig" if calibration.is_import else "there is a single pair"
    )
    lines = calibration.advice or (f"No advice: {why}.",)
    return Section("How well the pairs are connected, and what would help", [Lines(lines)])


def _boards(calibration: RigCalibration) -> Section:
    if not calibration.seen:
        why = (
            "This calibration was imported: no image of a board was read. `bodyscan check-calibration` "
            "tests it with a few."
            if calibration.is_import
            else "This calibration was stored without its corners: calibrate again to see where the "
            "boards lay in each picture, and their residuals."
        )
        return Section("Boards in the pictures", [Lines((why,))])
    residuals, times = draw.residual_chart(calibration)
    return Section(
        "Boards in the pictures",
        [
            Picture(
                "Coverage of each camera by boards",
                "Each camera's picture, and the hull of the corners of every board seen in it. Empty "
                "corners of a picture are where its lens is known least.",
                draw.coverage_chart(calibration),
            ),
            Picture(
                "Residuals of corners",
                "Colour: RMS over each part of the picture, px. Arrows: their mean, "
                f"enlarged {times:,.0f} times; arrows that all point the same way in a part of the "
                "picture mean that the lens model does not fit there. Empty: fewer than three corners.",
                residuals,
            ),
        ],
    )


def _planes(calibration: RigCalibration) -> Section:
    if all(pair.sheets is None for pair in calibration.pairs.values()):
        return Section("Light sheets", [Lines(("No pair has a projector.",))])
    return Section(
        "Light sheets",
        [
            Picture(
                "Baseline, projection angle and tilt",
                "Eq. 7-9 and Fig. 6 of the method's chapter, for every stripe boundary s, camera "
                "frame: where the plane cuts the baseline axis (mm from the optical centre), its "
                "angle about the axis the stripes run along, and how far it leans. For horizontal "
                "stripes x and y are exchanged. Smooth curves are right; a projector's lens bends "
                "them, a rotating mirror hardly does. Of bent sheets: their tangent planes.",
                draw.planes_chart(calibration),
            ),
            *_light_models(calibration),
        ],
    )


def _light_models(calibration: RigCalibration) -> list[Block]:
    """What was tried as a model of the light: nothing, if all of it was imported."""
    if not any(pair.quality.held_out for pair in calibration.pairs.values()):
        return [Lines(("No model of the light was tried on held-out boards: it was given.",))]
    return [
        Picture(
            "Models of the light on held-out boards",
            "Each model was fitted without a board and tried on it; mean distance from that board "
            "(mm, outliers capped). Filled: the model in use, the simplest that none after it "
            "beats by three standard errors at the same points.",
            draw.held_out_chart(calibration),
        ),
        Lines(tuple(_choice_lines(calibration))),
    ]


def _view_graph(calibration: RigCalibration) -> Section:
    if len(calibration.seen) < 2:
        return Section("Who shares boards with whom", [Lines(("There is nothing to share.",))])
    shared = draw.shared_boards(calibration)
    return Section(
        "Who shares boards with whom",
        intro="Two pairs are connected by boards that both saw at the same moment.",
        blocks=[
            Picture(
                "View graph",
                "Thicker: more boards in common.",
                draw.view_graph_chart(calibration),
            ),
            Picture(
                "Boards in common",
                "Number of boards seen by both at the same moment. Empty: none.",
                charts.matrix(
                    list(calibration.seen),
                    np.where(shared > 0, shared, np.nan),
                    "boards",
                    ".0f",
                ),
            ),
        ],
    )


def _sigma(calibration: RigCalibration) -> Section:
    title = "How well each place is known"
    why = why_no_sigma(calibration)
    if why is not None:
        return Section(title, [Lines((f"There is no map: {why[0]}; {why[1]}.",))])
    picture = Picture(
        "Sigma over the scan volume",
        "Error of a point from the poses of the pairs alone (one sigma, all axes together, "
        "mm), in two upright planes through the rig's axis. Stripe noise and the subject's sway are "
        "not in it. Light grey: nothing is measured there (no camera sees it, or a single one "
        "without a projector).",
        draw_sigma_map(calibration, height_px=charts.PICTURE_PX),
    )
    return Section(title, [picture])


def _notes(calibration: RigCalibration) -> Section:
    blocks: list[Block] = []
    if calibration.failed:
        failed = (f"failed: {name}: {why}" for name, why in calibration.failed.items())
        blocks.append(Lines(tuple(failed)))
    blocks.append(Lines(calibration.notes or ("Every image and view was used.",)))
    return Section("What was not used, and notes", blocks)
