"""`bodyscan reproduce`: simulates the chapter's set-up for its Tables 1 and 2, its Fig. 6 and 7."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import matplotlib
import numpy as np
from jinja2 import Environment, StrictUndefined
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from bodyscan.arrays import Array
from bodyscan.files.atomic import write_bytes, write_text
from bodyscan.geometry.light_planes import compute_baseline_angle_tilt
from bodyscan.geometry.robust import estimate_robust_scale
from bodyscan.geometry.transforms import fit_rigid_transform
from bodyscan.laboratory import apparatus
from bodyscan.laboratory.apparatus import ChapterCaptures
from bodyscan.laboratory.approaches import Approach, Calibrations, calibrate_all
from bodyscan.laboratory.measuring import (
    ApproachAccuracy,
    PointSigma,
    compare_point_sigmas,
    make_true_approach,
    measure_artefacts,
    triangulate_pixels,
)
from bodyscan.progress import Progress, silent
from bodyscan.reconstruction.triangulation import estimate_grid_normals
from bodyscan.report.charts import COLOURS, png, round_up, style

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
    calibrated: Calibrations
    whole: Sequence[ApproachAccuracy]
    fine: Sequence[ApproachAccuracy]
    by_stage: Sequence[ApproachAccuracy]
    by_reference: Sequence[ApproachAccuracy]
    sigmas: Sequence[PointSigma]


def reproduce(
    out: Path, *, seed: int = 0, real_light: bool = False, progress: Progress = silent
) -> tuple[str, tuple[str, ...]]:
    """Simulate, calibrate every approach, measure; returns the text, and the names of the files in
    `out`: that text, and the figures.

    seed: of all noise.
    real_light: a bowed board, speckle and everything else that an ideal simulation leaves out.
    """
    settings = apparatus.make_real_settings if real_light else apparatus.make_ideal_settings
    setup = apparatus.build_chapter_setup(settings(), seed)
    captures = apparatus.take_captures(setup, progress=progress)
    calibrated = calibrate_all(captures)
    compared = [*calibrated.approaches, make_true_approach(setup)]

    def measure(approaches: Sequence[Approach], whole: bool = False) -> list[ApproachAccuracy]:
        return [measure_artefacts(one, captures, whole=whole) for one in approaches]

    progress("measuring", 0, 1)
    found = Reproduction(
        seed,
        real_light,
        calibrated,
        whole=measure(compared, whole=True),
        fine=measure(compared),
        by_stage=measure(calibrated.by_stage),
        by_reference=measure(calibrated.by_reference),
        # Of the approaches whose sheets know their covariance.
        sigmas=[
            compare_point_sigmas(one, captures) for one in compared if one.name in ("(iii)", "ours")
        ],
    )
    progress("measuring", 1, 1)
    text, figures = render_reproduction(found), name_figures(real_light)
    draw(captures, calibrated, Path(out), figures)
    name = "reproduction-real-light.md" if real_light else "reproduction.md"
    write_text(Path(out) / name, text)
    return text, (name, *figures)


def name_figures(real_light: bool) -> tuple[str, str]:
    """Name the files of Fig. 6 and Fig. 7, which lie beside the text."""
    light = "-real-light" if real_light else ""
    return f"fig6-projector{light}.png", f"fig7-range-data{light}.png"


def draw(
    captures: ChapterCaptures, calibrated: Calibrations, out: Path, names: tuple[str, str]
) -> None:
    """Write Fig. 6 and Fig. 7 into the folder `out`, in files of these names."""
    by_name = {approach.name: approach for approach in calibrated.approaches}
    s = np.arange(apparatus.PROJECTOR.stripes + 1.0)
    planes = {name: by_name[name].sheets.tangent_planes(s) for name in ("(iii)", "ours", "(i)")}
    distances = calibrated.planes.distances_mm
    known = distances[np.isfinite(distances)]
    draw_projector(planes, s, apparatus.compute_true_planes(captures.setup), known, out / names[0])

    # Fig. 7: the spheres by each approach, aligned with the truth.
    measured, truth = captures.spheres.stripes.s, captures.spheres.truth
    true = apparatus.CAMERA.directions(apparatus.CAMERA.grid()) * truth.depth[..., None]
    data = {}
    for name in ("(i)", "(ii)", "(iii)", "ours"):
        points = triangulate_pixels(by_name[name], measured).reshape(true.shape)
        both = np.isfinite(points[..., 2]) & np.isfinite(truth.s)
        laid = np.full(points.shape, np.nan)
        laid[both] = fit_rigid_transform(points[both], true[both]).apply(points[both])
        normals = estimate_grid_normals(laid.astype(np.float32)).astype(float)
        data[name] = normals, laid[..., 2] - true[..., 2]
    draw_range_data(data, out / names[1])


@style()
def draw_projector(
    planes: Mapping[str, Array], s: Array, true: Array, residuals_mm: Array, path: Path
) -> None:
    """Draw Fig. 6: baseline, projection angle and tilt of each stripe; residuals of the planes.

    planes: of each approach, (N, 4) of Eq. 6 at stripe coordinates s (N,).
    true: as they are, (N, 4).
    """
    figure, axes = plt.subplots(2, 2, figsize=(10.0, 7.5), constrained_layout=True)
    labels = ("baseline, mm", "projection angle, degrees", "tilt angle, degrees")
    for part, (axis, label) in enumerate(zip(axes.ravel(), labels, strict=False)):
        values = _describe_planes(true)[part]
        axis.plot(s, values, color="#333333", linewidth=3.0, alpha=0.35, label="true")
        for colour, (name, found) in zip(COLOURS, planes.items(), strict=False):
            fitted = _describe_planes(found)[part]
            axis.plot(s, fitted, ".", color=colour, markersize=2.5, label=name)
        room = 0.6 * float(np.ptp(values)) + 1e-3
        if part != 1:
            axis.set_ylim(values.min() - room, values.max() + room)
        axis.set_xlabel("light stripe number")
        axis.set_ylabel(label)
    axes[0, 0].legend(frameon=False, markerscale=4.0)
    _plot_residuals(axes[1, 1], residuals_mm)
    for axis in axes.ravel():
        axis.grid(color="#999999", alpha=0.25, linewidth=0.6)
    write_bytes(path, png(figure, 750))


@style()
def draw_range_data(data: Mapping[str, tuple[Array, Array]], path: Path) -> None:
    """Draw Fig. 7: the spheres as measured, and their distance along the ray from the truth.

    data: of each approach, normals (H, W, 3) and distances (H, W) mm.
    """
    figure, axes = plt.subplots(
        2, len(data), figsize=(4.2 * len(data), 6.6), constrained_layout=True, squeeze=False
    )
    light = np.array([-0.4, -0.4, -0.83])
    colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad="#dddddd")
    for (upper, lower), (name, (normals, error_mm)) in zip(axes.T, data.items(), strict=True):
        grey = np.clip(np.nan_to_num(normals @ light, nan=0.0), 0.0, 1.0)
        upper.imshow(grey, cmap="gray", vmin=0.0, vmax=1.0)
        upper.set_title(name)
        limit = round_up(max(float(np.nanpercentile(np.abs(error_mm), 95)), 1e-6))
        picture = lower.imshow(error_mm, cmap=colours, vmin=-limit, vmax=limit)
        figure.colorbar(picture, ax=lower, shrink=0.8, label="off by, mm")
        for axis in (upper, lower):
            axis.set(xticks=[], yticks=[])
    write_bytes(path, png(figure, 750))


def _describe_planes(planes: Array) -> tuple[Array, Array, Array]:
    length, angle, tilt = compute_baseline_angle_tilt(planes, apparatus.PROJECTOR.direction)
    return length, np.degrees(angle), np.degrees(tilt)


def _plot_residuals(axis: Axes, residuals_mm: Array) -> None:
    """Plot the distribution of residuals, and a normal curve with their robust sigma."""
    sigma_mm = estimate_robust_scale(residuals_mm)
    edges = np.linspace(-8.0 * sigma_mm, 8.0 * sigma_mm, 161)
    density, _ = np.histogram(residuals_mm, edges)
    density = density / (len(residuals_mm) * np.diff(edges))
    axis.stairs(density, edges, fill=True, color=COLOURS[0], alpha=0.6)
    normal = np.exp(-0.5 * (edges / sigma_mm) ** 2) / (sigma_mm * np.sqrt(2.0 * np.pi))
    axis.plot(
        edges, normal, color="#333333", linewidth=1.0, label=f"normal, sigma {sigma_mm:.4f} mm"
    )
    axis.set_yscale("log")
    axis.set_ylim(normal.max() * 1e-4, normal.max() * 3.0)
    axis.set_xlabel("distance of a boundary point from its plane, mm")
    axis.set_ylabel("density, 1/mm")
    axis.legend(frameon=False, loc="upper right")


def render_reproduction(found: Reproduction) -> str:
    """Fill in the whole report, `reproduction.md.j2`, as Markdown."""
    template = (files("bodyscan.laboratory") / "reproduction.md.j2").read_text("utf-8")
    page = Environment(
        undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    ).from_string(template)
    sixth, seventh = name_figures(found.real_light)
    whole_times, fine_times = _compute_ratios(found.whole), _compute_ratios(found.fine)
    numbers = [f"No. {number}" for number in range(1, 6)]
    against_third = ["", *numbers, "mean over (iii)'s"]
    fitted = [
        [m.name, *(f"{s.e_fitted:.5f} ({s.fitted.radius:.3f})" for s in m.spheres)]
        for m in found.fine
    ]
    sigmas = [
        [
            one.name,
            *(f"{one.median_mm:.4f}", f"{one.spheres:.2f}", f"{one.plate:.2f}"),
            f"{100 * one.beyond_three:.2f} %",
        ]
        for one in found.sigmas
    ]
    return page.render(
        vars(found),
        sixth=sixth,
        seventh=seventh,
        table_1=_format_table_1(found.calibrated),
        whole_table=_format(
            against_third,
            [
                ["Measuring points", *(f"{s.points:,}" for s in found.fine[-1].spheres), ""],
                ["of lit pixels", *(f"{100 * c:.1f} %" for c in found.fine[-1].covered), ""],
                *_make_e_rows(found.whole, whole_times, digits=3),
                *(
                    [f"chapter {name}", *(f"{e:.2f}" for e in row), ""]
                    for name, row in CHAPTER_TABLE_2.items()
                ),
            ],
        ),
        fine_table=_format(against_third, _make_e_rows(found.fine, fine_times, digits=5)),
        fitted_table=_format(["", *numbers], fitted),
        accuracy=_format_accuracy(found.fine),
        point_sigmas=_format(["", "median sigma", "spheres", "plate", "beyond 3 sigmas"], sigmas),
        by_stage=_format_accuracy(found.by_stage),
        by_reference=_format_accuracy(found.by_reference),
        whole_times=whole_times,
        fine_times=fine_times,
        systematic_mm={m.name: m.plate_systematic_mm for m in found.fine},
    )


def _compute_ratios(all_: Iterable[ApproachAccuracy]) -> dict[str, float]:
    """Divide each approach's mean E by that of (iii)."""
    mean = {m.name: m.mean_e for m in all_}
    return {name: e / mean["(iii)"] for name, e in mean.items()}


def _make_e_rows(
    all_: Iterable[ApproachAccuracy], times: Mapping[str, float], digits: int
) -> list[list[str]]:
    return [
        [m.name, *(f"{s.e_given:.{digits}f}" for s in m.spheres), f"{times[m.name]:.2f}"]
        for m in all_
    ]


def _format_table_1(calibrated: Calibrations) -> str:
    """The camera's parameters by both calibrations; "off by" is in sigmas."""
    zhang, ours = calibrated.reference, calibrated.ours.camera
    estimates = (
        (zhang.camera.parameters, np.sqrt(np.diag(zhang.covariance))),
        (ours.parameters, np.sqrt(np.diag(calibrated.camera_covariance))),
    )
    rows = []
    for number, name in enumerate(zhang.camera.parameter_names):
        true = getattr(apparatus.CAMERA, name)
        row = [name, f"{true:.7g}"]
        for values, sigmas in estimates:
            value, sigma = values[number], sigmas[number]
            row += [f"{value:.7g}", f"{sigma:.2g}", f"{(value - true) / sigma:+.1f}"]
        rows.append(row)
    return _format(["", "true", "corners", "sigma", "off by", "ours", "sigma", "off by"], rows)


def _format_accuracy(all_: Iterable[ApproachAccuracy]) -> str:
    columns: dict[str, Callable[[ApproachAccuracy], str]] = {
        "": lambda m: m.name,
        "mean E": lambda m: f"{m.mean_e:.5f}",
        "plate RMS": lambda m: f"{m.plate.rms_mm:.4f}",
        "smooth part": lambda m: f"{m.plate.systematic_rms_mm:.4f}",
        "systematic": lambda m: f"{m.plate_systematic_mm:.4f}",
        "centres RMS": lambda m: f"{m.distances.rms_mm:.4f}",
        "scale ppm": lambda m: f"{m.distances.scale_ppm:+.0f}",
    }
    return _format([*columns], [[cell(m) for cell in columns.values()] for m in all_])


def _format(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table whose columns are padded so that its source is readable too."""
    cells = [heading, *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    sides = ["<", *">" * (len(widths) - 1)]
    padded = (
        [f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)]
        for row in cells
    )
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)
