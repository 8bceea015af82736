"""The reproduced tables as Markdown text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.laboratory import apparatus
from bodyscan.laboratory.calibrating import Calibrations
from bodyscan.laboratory.measuring import ApproachAccuracy, PointSigma

CHAPTER_TABLE_2 = {
    "(i)": (0.41, 0.38, 0.26, 0.26, 0.31),
    "(ii)": (0.22, 0.31, 0.19, 0.13, 0.20),
    "(iii)": (0.23, 0.32, 0.21, 0.15, 0.21),
}


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Everything that was found.

    whole, fine: the approaches and, last, the true calibration, from one whole stripe per pixel and
        from sub-pixel boundaries.
    by_stage, by_reference: every projector model, sub-pixel.
    sigmas: depth errors over the points' sigmas.
    """

    seed: int
    real_light: bool
    boards: int
    calibrated: Calibrations
    whole: tuple[ApproachAccuracy, ...]
    fine: tuple[ApproachAccuracy, ...]
    by_stage: tuple[ApproachAccuracy, ...]
    by_reference: tuple[ApproachAccuracy, ...]
    sigmas: tuple[PointSigma, ...]


def reproduction_text(found: Reproduction) -> str:
    """Format the whole report as Markdown."""
    parts = [
        _heading(found),
        _table_1(found),
        _table_2(found),
        _against_truth(found),
        _point_sigmas(found),
        _rivals(found),
        _remarks(found),
        _figures_of(found),
    ]
    return "\n\n".join(parts) + "\n"


def _heading(found: Reproduction) -> str:
    light = (
        "a board bowed by 0.1 mm and printed to 0.02 mm, 6 % speckle, a smile of 0.2 stripes, 0.01 "
        "stripe of jitter, defocus, a third of the photons"
        if found.real_light
        else "a flat, exact board and the simulator's own sensor noise"
    )
    return (
        "# The chapter's experiments, simulated\n\n"
        "Table 1's camera, 254 stripes from a mirror whose surface lies off its axis, Gray code with "
        f"inverse, 48 corners 20 mm apart in {found.boards} poses, five spheres of 25 mm radius at "
        "about 400 mm. All of it goes through rendered images and the real decoder. "
        f"Light: {light}. Seed {found.seed}. Lengths in mm, E in mm^2."
    )


def _table_1(found: Reproduction) -> str:
    rows = []
    zhang, ours = found.calibrated.reference, found.calibrated.ours
    for number, name in enumerate(zhang.camera.parameter_names):
        true = getattr(apparatus.CAMERA, name)
        row = [name, f"{true:.7g}"]
        for camera, covariance in (
            (zhang.camera, zhang.covariance),
            (ours.camera, found.calibrated.camera_covariance),
        ):
            value, sigma = camera.parameters[number], float(np.sqrt(covariance[number, number]))
            row += [f"{value:.7g}", f"{sigma:.2g}", f"{(value - true) / sigma:+.1f}"]
        rows.append(row)
    heading = ["", "true", "corners", "sigma", "off by", "joint", "sigma", "off by"]
    return (
        "## Table 1: camera parameters\n\n"
        + _table(heading, rows)
        + "\n\n`corners`: the chapter's way, Zhang's method on the corners, its sigma "
        "that of their noise alone. `joint`: ours, corners and stripes in one solve, its sigma with "
        "what is open of the board's warp and print. `off by`: estimated "
        "less true, in sigmas. "
        f"Corners' residual {zhang.rms_px:.4f} px RMS. Ours: {found.calibrated.model}; "
        f"solved by: {found.calibrated.refinement}."
    )


def _table_2(found: Reproduction) -> str:
    numbers = [f"No. {number}" for number in range(1, 6)]
    points = ["Measuring points", *(f"{s.points:,}" for s in found.fine[-1].spheres)]
    covered = ["of lit pixels", *(f"{100 * c:.1f} %" for c in found.fine[-1].covered)]
    whole = [
        [m.name, *(f"{s.e_given:.3f}" for s in m.spheres), f"{_times(found.whole, m):.2f}"]
        for m in found.whole
    ]
    printed = [
        [f"chapter {name}", *(f"{e:.2f}" for e in row), ""] for name, row in CHAPTER_TABLE_2.items()
    ]
    fine = [
        [m.name, *(f"{s.e_given:.5f}" for s in m.spheres), f"{_times(found.fine, m):.2f}"]
        for m in found.fine
    ]
    fitted = [
        [m.name, *(f"{s.e_fitted:.5f} ({s.fitted.radius:.3f})" for s in m.spheres)]
        for m in found.fine
    ]
    last = "mean over (iii)'s"
    return "\n\n".join(
        [
            "## Table 2: E (Eq. 19) of each sphere",
            "One whole stripe a pixel, as the chapter's instrument gives it (in its range data a grey "
            "level is a stripe's number):",
            _table(["", *numbers, last], [[*points, ""], [*covered, ""], *whole, *printed]),
            "Sub-pixel boundaries, radius held at 25:",
            _table(["", *numbers, last], fine),
            "Sub-pixel boundaries, radius fitted (the radius in brackets):",
            _table(["", *numbers], fitted),
            "Every measured pixel whose centre sees a sphere that the projector lights counts; none is "
            "left out as an outlier. `true calibration`: the simulator's own camera and sheets, "
            "smile and all, on the decoded stripes: what nothing can better but by chance.",
        ]
    )


def _against_truth(found: Reproduction) -> str:
    rows = [_figures(m) for m in found.fine]
    return (
        "## What E does not see\n\n"
        + _table(ACCURACY_COLUMNS, rows)
        + "\n\nE hardly depends on the calibration (compare the true one's with (iii)'s), these do. "
        "`plate`: a flat plate of 160 x 120 mm as decoded, RMS from its own plane, and of that the "
        "smooth part; `systematic`: the same plate with every pixel's stripe coordinate known exactly, "
        "so that nothing but the calibration is left. `centres`: errors of the ten distances between "
        "the spheres' centres; `scale`: the same as one factor."
    )


def _point_sigmas(found: Reproduction) -> str:
    rows = [
        [
            one.name,
            f"{one.median_mm:.4f}",
            f"{one.spheres:.2f}",
            f"{one.plate:.2f}",
            f"{100 * one.beyond_three:.2f} %",
        ]
        for one in found.sigmas
    ]
    return (
        "## The points' own sigmas\n\n"
        + _table(["", "median sigma", "spheres", "plate", "beyond 3 sigmas"], rows)
        + "\n\n`spheres`, `plate`: root mean square of (depth less true depth) over sigma, every "
        "measured pixel counted; 1 if sigmas are right. A sigma is made of the decoder's and of the "
        "sheets' covariance. Ours holds what is open of camera, boards' places, bend and print, "
        "which is most of it and common to all points, so that one run is one draw of it; (iii)'s only "
        "the noise of each plane's own boundaries."
    )


def figure_names(real_light: bool) -> tuple[str, str]:
    """Name the files of Fig. 6 and Fig. 7, which lie beside the text."""
    light = "-real-light" if real_light else ""
    return f"fig6-projector{light}.png", f"fig7-range-data{light}.png"


def text_name(real_light: bool) -> str:
    """Name the file of the text."""
    return "reproduction-real-light.md" if real_light else "reproduction.md"


def _figures_of(found: Reproduction) -> str:
    sixth, seventh = figure_names(found.real_light)
    return (
        "## Figures 6 and 7\n\n"
        f"![Baselines, projection angles, tilts; distances of points from their planes]({sixth})\n\n"
        "Fig. 6: each stripe's plane, as the approaches find it and as it is.\n\n"
        f"![Five spheres as each approach measures them]({seventh})\n\n"
        "Fig. 7: the spheres, shaded, and below how far they are from the truth along the viewing ray."
    )


ACCURACY_COLUMNS = [
    "",
    "mean E",
    "plate RMS",
    "smooth part",
    "systematic",
    "centres RMS",
    "scale ppm",
]


def _figures(m: ApproachAccuracy) -> list[str]:
    return [
        m.name,
        f"{m.mean_e:.5f}",
        f"{m.plate.rms_mm:.4f}",
        f"{m.plate.systematic_rms_mm:.4f}",
        f"{m.plate_systematic_mm:.4f}",
        f"{m.distances.rms_mm:.4f}",
        f"{m.distances.scale_ppm:+.0f}",
    ]


def _rivals(found: Reproduction) -> str:
    return "\n\n".join(
        [
            "## The rival projectors",
            "Calibrated by the slide stage (Tsai's camera with its lens):",
            _table(ACCURACY_COLUMNS, [_figures(m) for m in found.by_stage]),
            "Calibrated by the reference plane in three poses (Zhang's camera):",
            _table(ACCURACY_COLUMNS, [_figures(m) for m in found.by_reference]),
            "`tilted`: the baseline's direction in the image is fitted, not taken for the camera's x "
            "axis. The baseline models are given an angle of their own for every stripe.",
        ]
    )


def _remarks(found: Reproduction) -> str:
    first, mended, second, skewed = (
        next(m for m in found.fine if m.name == n)
        for n in ("(i)", "(i) mended", "(ii)", "(ii) with skew")
    )
    coarse = next(m for m in found.whole if m.name == "(ii)")
    whole = next(m for m in found.whole if m.name == "(i)")
    return "\n".join(
        [
            "## Remarks on the chapter",
            "",
            "- Eq. 19 is a mean square, so Table 2 is in mm^2, though the text calls E a distance: its "
            "0.2 is 0.45 mm RMS.",
            "- `In the approach (i), the measurement accuracy is higher than the approach (ii) and "
            "(iii)` contradicts the chapter's own numbers: (i) has the largest E on every sphere, and "
            "its left spheres and ground are said to be distorted. E is larger, accuracy lower.",
            "- Approach (ii) is headed `calibrated by slide stage`, its text takes the projector from "
            "the reference plane. The text is followed: Tsai's camera from the stage, planes from the "
            "three poses. Free planes from the stage itself stand under the rivals.",
            "- (ii) and (iii) are alike where the chapter compares them, with whole stripes: "
            f"{_times(found.whole, coarse):.2f} times. With sub-pixel boundaries (ii) has "
            f"{_times(found.fine, second):.1f} times the E of (iii), because Tsai's camera has no "
            "skew and Table 1's has one, 0.1 px at the picture's rim: the same "
            f"camera from the same stage with gamma free has {_times(found.fine, skewed):.1f} times.",
            "- (i) as the chapter has it (no lens, index taken as linear) has "
            f"{_times(found.whole, whole):.2f} times the E of (iii) with whole stripes, and "
            f"{_times(found.fine, first):.1f} times with sub-pixel boundaries: whole stripes hide what "
            "a calibration is worth. Mended (lens corrected, index re-mapped) it has "
            f"{_times(found.fine, mended):.2f} times.",
            f"- A sphere of {apparatus.RADIUS_MM:g} mm is small against the bend of a wrong "
            f"calibration; the plate shows it: {first.plate_systematic_mm:.3f} mm RMS for (i), "
            f"{mended.plate_systematic_mm:.3f} mended.",
        ]
    )


def _times(all_: Sequence[ApproachAccuracy], one: ApproachAccuracy) -> float:
    """Divide an approach's mean E by that of (iii)."""
    third = next(m for m in all_ if m.name == "(iii)")
    return one.mean_e / third.mean_e


def _table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table whose columns are padded so that its source is readable too."""
    cells = [list(heading), *(list(row) for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(heading))]

    def line(row: Sequence[str]) -> str:
        padded = [row[0].ljust(widths[0])]
        padded += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        return f"| {' | '.join(padded)} |"

    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    return "\n".join([line(cells[0]), line(rule), *(line(row) for row in cells[1:])])
