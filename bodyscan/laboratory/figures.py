"""The chapter's figures 6 and 7 drawn from the results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from bodyscan.arrays import Array
from bodyscan.files.atomic import write_bytes
from bodyscan.geometry.light_planes import baseline_angle_tilt
from bodyscan.geometry.robust import robust_scale
from bodyscan.laboratory.apparatus import PROJECTOR
from bodyscan.report.charts import COLOURS, png, round_up, style


@style()
def draw_projector(
    planes: Mapping[str, Array], s: Array, true: Array, residuals_mm: Array, path: Path
) -> None:
    """Draw Fig. 6: baseline, projection angle and tilt of each stripe; residuals of the planes.

    planes: of each approach, (N, 4) of Eq. 6 at stripe coordinates s (N,).
    true: as they are, (N, 4).
    """
    figure, axes = plt.subplots(2, 2, figsize=(10.0, 7.5), constrained_layout=True)
    for axis, part, label in zip(
        axes.ravel(),
        range(3),
        ("baseline, mm", "projection angle, degrees", "tilt angle, degrees"),
        strict=False,
    ):
        values = _baseline_angle_tilt(true)[part]
        axis.plot(s, values, color="#333333", linewidth=3.0, alpha=0.35, label="true")
        for colour, (name, found) in zip(COLOURS, planes.items(), strict=False):
            shown = _baseline_angle_tilt(found)[part]
            axis.plot(s, shown, ".", color=colour, markersize=2.5, label=name)
        room = 0.6 * float(np.ptp(values)) + 1e-3
        if part != 1:
            axis.set_ylim(values.min() - room, values.max() + room)
        axis.set_xlabel("light stripe number")
        axis.set_ylabel(label)
    axes[0, 0].legend(frameon=False, markerscale=4.0)
    _distribution(axes[1, 1], residuals_mm)
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


def _baseline_angle_tilt(planes: Array) -> tuple[Array, Array, Array]:
    length, angle, tilt = baseline_angle_tilt(planes, PROJECTOR.direction)
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
