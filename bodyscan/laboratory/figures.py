"""The chapter's figures 6 and 7 drawn from the results. Matplotlib is imported only here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

from bodyscan.arrays import Array
from bodyscan.files.atomic import atomic_replacement
from bodyscan.geometry.light_planes import Axis, baseline_angle_tilt
from bodyscan.geometry.robust import robust_scale
from bodyscan.report.charts import round_up

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Okabe and Ito's colours, which the colour-blind can tell apart too."""


@dataclass(frozen=True, eq=False)
class PlaneCurve:
    """A model's planes (N, 4) of Eq. 6 at stripe coordinates s (N,)."""

    name: str
    s: Array
    planes: Array


def draw_projector(
    curves: Sequence[PlaneCurve], true: PlaneCurve, residuals_mm: Array, direction: Axis, path: Path
) -> Path:
    """Draw Fig. 6: baseline, projection angle and tilt of each stripe; residuals of the planes."""
    figure, axes = plt.subplots(2, 2, figsize=(10.0, 7.5), constrained_layout=True)
    baseline, angle, tilt, residual_axis = axes.ravel()
    for axis, part, label in (
        (baseline, 0, "baseline, mm"),
        (angle, 1, "projection angle, degrees"),
        (tilt, 2, "tilt angle, degrees"),
    ):
        values = _baseline_angle_tilt(true, direction)[part]
        axis.plot(true.s, values, color="#333333", linewidth=3.0, alpha=0.35, label=true.name)
        for colour, curve in zip(COLOURS, curves, strict=False):
            values_of_model = _baseline_angle_tilt(curve, direction)[part]
            axis.plot(curve.s, values_of_model, ".", color=colour, markersize=2.5, label=curve.name)
        room = 0.6 * float(np.ptp(values)) + 1e-3
        if part != 1:
            axis.set_ylim(values.min() - room, values.max() + room)
        axis.set_xlabel("light stripe number")
        axis.set_ylabel(label)
    baseline.legend(frameon=False, markerscale=4.0)
    _distribution(residual_axis, residuals_mm)
    for axis in axes.ravel():
        _plain(axis)
    return _save(figure, path)


@dataclass(frozen=True, eq=False)
class RangeData:
    """normals: (H, W, 3). error_mm: (H, W) mm, distance from the truth."""

    name: str
    normals: Array
    error_mm: Array


def draw_range_data(data: Sequence[RangeData], path: Path) -> Path:
    """Draw Fig. 7: the spheres as measured, and their distance along the ray from the truth."""
    figure, axes = plt.subplots(
        2, len(data), figsize=(4.2 * len(data), 6.6), constrained_layout=True, squeeze=False
    )
    for upper, lower, one in zip(axes[0], axes[1], data, strict=True):
        light = np.array([-0.4, -0.4, -0.83])
        grey = np.clip(np.nan_to_num(one.normals @ light, nan=0.0), 0.0, 1.0)
        upper.imshow(grey, cmap="gray", vmin=0.0, vmax=1.0)
        upper.set_title(one.name)
        limit = round_up(max(float(np.nanpercentile(np.abs(one.error_mm), 95)), 1e-6))
        colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad="#dddddd")
        picture = lower.imshow(one.error_mm, cmap=colours, vmin=-limit, vmax=limit)
        figure.colorbar(picture, ax=lower, shrink=0.8, label="off by, mm")
        for axis in (upper, lower):
            axis.set_xticks([])
            axis.set_yticks([])
    return _save(figure, path)


def _baseline_angle_tilt(curve: PlaneCurve, direction: Axis) -> tuple[Array, Array, Array]:
    length, angle, tilt = baseline_angle_tilt(curve.planes, direction)
    return length, np.degrees(angle), np.degrees(tilt)


def _distribution(axis: Axes, residuals_mm: Array) -> None:
    """Plot the distribution of residuals, and a normal curve with their robust sigma."""
    sigma_mm = robust_scale(residuals_mm)
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


def _plain(axis: Axes) -> None:
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    axis.grid(color="#999999", alpha=0.25, linewidth=0.6)


def _save(figure: matplotlib.figure.Figure, path: Path) -> Path:
    # Without date and version the same figure gives the same bytes.
    with atomic_replacement(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})
    plt.close(figure)
    return path
