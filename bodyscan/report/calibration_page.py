"""A calibration's report: how well each pair and the whole rig are known."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import astuple
from pathlib import Path

import numpy as np

from bodyscan.calibration.lens_selection import MIN_CLUSTERS
from bodyscan.errors import BadInput
from bodyscan.registration.calibration_verdict import LIMITS, collect_figures, grade_calibration
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import FILE_NAME, calibration_id, load_calibration
from bodyscan.report import calibration_charts as draw
from bodyscan.report import charts
from bodyscan.report.page import (
    Block,
    Column,
    Lines,
    Page,
    Picture,
    Table,
    Viewer,
    is_synthetic,
    make_sections,
)

TITLES = {
    "corners_rms_px": ("corners", "px RMS", "distance of corners from where camera and pose put them."),
    "poses": ("poses", "", "views of a board that were used."),
    "covered_percent": ("covered", "% of image",
                        "by the boards' corners; the lens is extrapolated beyond."),
    "sheets_rms_mm": ("sheets", "mm RMS", "distance of stripe boundaries on boards from their sheet."),
    "held_out_mm": ("held out", "mm mean", "distance of points from boards that the light was not "
                    "fitted to; outliers capped."),
    "stripe_shots": ("striped", "", "boards on which stripes were decoded."),
    "stripes_percent": ("stripes", "% known", "boundaries between stripes that have a sheet, of those "
                        "projected; the others fell beyond the boards."),
    "sigma_mm": ("sigma", "mm", "of the camera's position in the rig frame, all axes together, from "
                 "the covariance of the joint solve."),
}  # fmt: skip
"""Heading, unit and meaning of each figure that has a limit."""
PAIR_COLUMNS = (
    Column("pair"),
    *(
        Column(*TITLES[figure], limit.value, limit.at_least, digits=0 if limit.at_least else 3)
        for figure, limit in LIMITS.items()
    ),
    Column("light", "", "model of the light sheets, chosen by held-out boards."),
    Column("lens", "", "chosen by held-out boards, or named in the rig file; see below."),
)


def make_calibration_page(folder: Path) -> Page:
    """The report of the calibration in `folder`. Raises CalibrationFileError."""
    calibration = load_calibration(folder)
    shots = len({shot for shot, _ in calibration.rig_from_board})
    model = (
        "Pyramids: cameras and what they see. Grey: boards, and the scan volume. Red, green and blue: "
        "the rig's axes x, y and z."
    )
    imported = "another program calibrated the rig"
    why = imported if calibration.is_import else "there is a single pair"
    notes = calibration.notes or ("Every image and view was used.",)
    parts: dict[str, Callable[[], list[Block]]] = {
        "The rig": lambda: [
            Viewer("Cameras in the rig frame", model, draw.build_rig_model(calibration))
        ],
        "Pairs": lambda: _tabulate_pairs(calibration),
        "How well the pairs are connected, and what would help": lambda: [
            Lines(calibration.advice or (f"No advice: {why}.",))
        ],
        "Boards in the images": lambda: _show_boards(calibration),
        "Light sheets": lambda: _show_planes(calibration),
        "Who shares boards with whom": lambda: _show_shared_boards(calibration),
        "How well each place is known": lambda: _show_sigma(calibration),
        "What was not used, and notes": lambda: [Lines(notes)],
    }
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
        make_sections(parts),
    )


def _tabulate_pairs(calibration: RigCalibration) -> list[Block]:
    rows = []
    for one in collect_figures(calibration):
        pair = calibration.pairs[one.name]
        rows.append((*astuple(one), pair.quality.light_model, pair.camera.lens.kind))
    return [Table(PAIR_COLUMNS, tuple(rows)), Lines(tuple(_describe_lenses(calibration)))]


def _describe_lenses(calibration: RigCalibration) -> Iterator[str]:
    """Describe how well each lens that was tried predicted held-out boards."""
    for name, pair in calibration.pairs.items():
        tried = [
            f"{one.kind} {one.rms_px:.3f} px{_format_gain(one.gain)}" for one in pair.quality.lenses
        ]
        yield f"{name}: lens {pair.camera.lens.kind}; " + (
            f"held-out corners, RMS: {'; '.join(tried)}"
            if tried
            else "none was tried on held-out boards (it was given, or boards stood in fewer than "
            f"{MIN_CLUSTERS} places of the image)"
        )


def _describe_light_models(calibration: RigCalibration) -> Iterator[str]:
    """How each model of the light that was tried did on held-out boards, and what was refined."""
    for name, pair in calibration.pairs.items():
        quality = pair.quality
        if quality.held_out:
            tried = (
                f"{one.model} {one.mean_mm:.3f} mm{_format_gain(one.gain)}"
                for one in quality.held_out
            )
            yield f"{name}: light {quality.light_model}; held-out boards, mean: {'; '.join(tried)}"
        if quality.refinement:
            yield f"{name}: solved by {quality.refinement}"
        for board, mm in quality.bent_mm.items():
            yield f"{name}: board {board} is bent by {mm:.3f} mm, lowest to highest corner"


def _format_gain(gain: float | None) -> str:
    return "" if gain is None else f" ({gain:+z.1f} standard errors better)"


def _show_boards(calibration: RigCalibration) -> list[Block]:
    if not calibration.observed:
        why = (
            "This calibration was imported: no image of a board was read. `bodyscan check-calibration` "
            "tests it with a few."
            if calibration.is_import
            else "This calibration was stored without its corners: calibrate again to see where the "
            "boards lay in each image, and their residuals."
        )
        return [why]
    residuals, times = draw.draw_residual_chart(calibration)
    return [
        Picture(
            "Coverage of each camera by boards",
            "Each camera's image, and the hull of the corners of every board seen in it. Empty "
            "corners of an image are where its lens is known least.",
            draw.draw_coverage_chart(calibration),
        ),
        Picture(
            "Residuals of corners",
            "Colour: RMS over each part of the image, px. Arrows: their mean, "
            f"enlarged {times:,.0f} times; arrows that all point the same way in a part of the "
            "image mean that the lens model does not fit there. Empty: fewer than three corners.",
            residuals,
        ),
    ]


def _show_planes(calibration: RigCalibration) -> list[Block]:
    if all(pair.sheets is None for pair in calibration.pairs.values()):
        return ["No pair has a projector."]
    tried = "No model of the light was tried on held-out boards: it was given."
    if any(pair.quality.held_out for pair in calibration.pairs.values()):
        tried = (
            "Each model was fitted without a board and tried on it; mean distance from that board "
            "(mm, outliers capped). In use: the simplest that none after it beats by three standard "
            "errors at the same points."
        )
    planes = Picture(
        "Baseline, projection angle and tilt",
        "Eq. 7-9 and Fig. 6 of the method's chapter, for every stripe boundary s, camera "
        "frame: where the plane cuts the baseline axis (mm from the optical centre), its "
        "angle about the axis the stripes run along, and how far it leans. For horizontal "
        "stripes x and y are exchanged. Smooth curves are right; a projector's lens bends "
        "them, a rotating mirror hardly does. Of bent sheets: their tangent planes.",
        draw.draw_planes_chart(calibration),
    )
    return [planes, tried, Lines(tuple(_describe_light_models(calibration)))]


def _show_shared_boards(calibration: RigCalibration) -> list[Block]:
    if len(calibration.observed) < 2:
        return ["There is nothing to share."]
    shared = draw.count_shared_boards(calibration)
    counts = np.where(shared > 0, shared, np.nan)
    caption = (
        "Number of boards that two pairs saw at the same moment, which connect them. Empty: none."
    )
    chart = charts.matrix(list(calibration.observed), counts, "boards", ".0f")
    return [Picture("View graph: boards in common", caption, chart)]


def _show_sigma(calibration: RigCalibration) -> list[Block]:
    try:
        picture = draw.draw_sigma_chart(calibration)
    except BadInput as error:
        return [f"There is no map: {error.what}; {error.remedy}."]
    return [
        Picture(
            "Sigma over the scan volume",
            "Error of a point from the poses of the pairs alone (one sigma, all axes together, "
            "mm), in two upright planes through the rig's axis. Stripe noise and the subject's sway "
            "are not in it. Light grey: nothing is measured there (no camera sees it, or a single one "
            "without a projector).",
            picture,
        )
    ]
