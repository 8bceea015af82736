"""Tables for people, and the same figures for --json."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from rich.table import Table

from bodyscan.fusion.storage import Scan
from bodyscan.geometry.uncertainty import compute_position_sigma
from bodyscan.mesh.body import compute_cover_shares
from bodyscan.registration.rig_calibration import RigCalibration


def calibration_table(calibration: RigCalibration) -> Table:
    """One row a pair: residuals, stripes, position and its sigma in the rig frame."""
    table = Table("pair", title=f"rig {calibration.rig.name}")
    for heading in (
        *("corners RMS px", "poses", "lens", "light", "sheets RMS mm", "stripes"),
        *("position mm (x, y, z)", "sigma mm"),
    ):
        table.add_column(heading, justify="right")
    for name, pair in calibration.pairs.items():
        quality = pair.quality
        position = calibration.rig_from_camera[name].translation
        sigma = compute_position_sigma(calibration.covariance, name, position)
        known = " ".join(f"{value:.3f}" for value in sigma) if sigma.any() else "defines the frame"
        stripes = f"{quality.stripes_calibrated} of {quality.stripes_projected}"
        table.add_row(
            name,
            "-" if quality.corners_rms_px is None else f"{quality.corners_rms_px:.3f}",
            "-" if quality.imported else str(quality.poses),
            pair.camera.lens.kind,
            quality.light_model or "-",
            "-" if quality.planes_rms_mm is None else f"{quality.planes_rms_mm:.3f}",
            "-" if pair.sheets is None else stripes,
            " ".join(f"{value:.1f}" for value in position),
            "not known" if quality.unjudged else known,
        )
    for name in calibration.failed:
        table.add_row(name, "failed", *["-"] * 7, style="red")
    return table


def calibration_figures(calibration: RigCalibration) -> dict[str, Any]:
    """The table's figures, by pair."""
    return {
        name: {
            "corners_rms_px": pair.quality.corners_rms_px,
            "poses": pair.quality.poses,
            "lens": pair.camera.lens.kind,
            "lenses_tried": [asdict(tried) for tried in pair.quality.lenses],
            "light_model": pair.quality.light_model,
            "light_tried": [asdict(tried) for tried in pair.quality.held_out],
            "solved": pair.quality.refinement or None,
            "boards_bent_mm": pair.quality.bent_mm,
            "sheets_rms_mm": pair.quality.planes_rms_mm,
            "stripes_calibrated": pair.quality.stripes_calibrated,
            "imported": pair.quality.imported or None,
            "position_mm": calibration.rig_from_camera[name].translation.tolist(),
        }
        for name, pair in calibration.pairs.items()
    }


def scan_table(scan: Scan) -> Table:
    """What a scan gave: counts, error bars, alignment."""
    table = Table("", "", title="body model", show_header=False)
    table.columns[1].justify = "right"
    cloud, surface = scan.cloud, scan.mesh
    table.add_row("pairs measured", str(sum(points > 0 for points in scan.measured.values())))
    table.add_row("points measured by all pairs", f"{sum(scan.measured.values()):,}")
    table.add_row("points in the cloud", f"{len(cloud.points):,}")
    table.add_row("sigma of a point, median", f"{np.nanmedian(cloud.sigma_mm):.3f} mm")
    table.add_row("faces of the mesh", f"{len(surface.faces):,}")
    table.add_row("of its surface filled", f"{100.0 * surface.filled_share:.1f} %")
    covered = compute_cover_shares(cloud.regions)
    if covered:
        shares = ", ".join(f"{name} {100.0 * share:.1f} %" for name, share in covered.items())
        table.add_row("points not on skin", shares)
    if scan.alignment is not None:
        before, after = scan.alignment.rms_before_mm, scan.alignment.rms_after_mm
        known = (
            f"{before:.3f}, {after:.3f} mm RMS" if np.isfinite([before, after]).all() else "none"
        )
        table.add_row("overlaps before, after alignment", known)
        for name, motion in sorted(scan.alignment.motion_mm.items(), key=lambda item: -item[1])[:1]:
            table.add_row("farthest moved", f"{name}, {motion:.2f} mm")
        for name, sigmas in scan.alignment.refused.items():
            table.add_row("left where it was", f"{name} (would have moved by {sigmas:.1f} sigmas)")
    if scan.person is not None:
        for line in filter(None, (scan.person.summary, *scan.person.lines)):
            table.add_row("the person", line)
    return table


def scan_figures(scan: Scan) -> dict[str, Any]:
    """The table's figures."""
    return {
        "points_measured": scan.measured,
        "points": len(scan.cloud.points),
        "faces": len(scan.mesh.faces),
        "sigma_mm": float(np.nanmedian(scan.cloud.sigma_mm)),
        "filled_share": scan.mesh.filled_share,
        "regions": scan.cloud.region_shares,
        "sway_mm": scan.alignment.motion_mm if scan.alignment else None,
    }
