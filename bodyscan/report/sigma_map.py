"""Map the sigma that the pairs' poses cause at each point of the scan volume."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from bodyscan.arrays import Array, Indices
from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_bytes
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import MAP_NAME, load_calibration
from bodyscan.report import charts
from bodyscan.rig.rig import Volume

PLANES = {
    "front: y to the right, z up": (0.0, 1.0, 0.0),
    "side: x to the left, z up": (-1.0, 0.0, 0.0),
}
"""Planes through the rig's axis, by the direction to the picture's right."""


def sigma_at(
    points: Array,
    rig_from_camera: Mapping[str, RigidTransform],
    cameras: Mapping[str, Camera],
    covariance: PoseCovariance,
    alone: Collection[str],
) -> tuple[Array, Indices]:
    """Sigma (N,) mm at rig points (N, 3), all axes together, and how many pairs see each (N,).

    alone: pairs with a projector, which measure points that no other pair sees.

    A point is the mean of what the pairs that see it measure, so only their common error, and a
    share of their independent errors, remains. Poses alone: no stripe noise, no swaying subject.
    NaN where nothing is measured: a camera without a projector measures depth only with another.
    """
    visible = np.stack(
        [
            is_in_image(cameras[name], rig_from_camera[name].inverse().apply(points))
            if name in cameras
            else np.zeros(len(points), bool)
            for name in covariance.names
        ],
        axis=1,
    )
    count = visible.sum(axis=1)
    masks, which = np.unique(visible, axis=0, return_inverse=True)
    shares = masks / np.maximum(masks.sum(axis=1, keepdims=True), 1)
    pairs = len(covariance.names)
    blocks = covariance.matrix.reshape(pairs, 6, pairs, 6)
    motions = np.einsum("mp,piqj,mq->mij", shares, blocks, shares, optimize=True)
    jacobian = twist_jacobian(points)
    variance = np.einsum("nki,nij,nkj->n", jacobian, motions[which.reshape(-1)], jacobian)
    lit = visible[:, [name in alone for name in covariance.names]].any(axis=1)
    measured = lit | (count > 1)
    return np.where(measured, np.sqrt(np.maximum(variance, 0.0)), np.nan), count


def draw_sigma_map(calibration: RigCalibration) -> bytes:
    """Maps of `sigma_at` in the planes x = 0 (front) and y = 0 (side) on one colour scale, as PNG.

    Light grey where nothing is measured. Raises BadInput if no sigma is known.
    """
    unknown = [name for name, pair in calibration.pairs.items() if pair.quality.unjudged]
    if unknown:
        raise BadInput(
            f"the accuracy of the imported calibration of {', '.join(unknown)} is not known",
            where=f"rig {calibration.rig.name}",
            remedy="state it when importing (`import --sigma-px`), measure it with shots of a board "
            "(`check-calibration`), or calibrate with bodyscan (`calibrate-rig`)",
        )
    if len(calibration.pairs) == 1:
        raise BadInput(
            "a single pair defines the rig frame, so its pose has no error",
            where=f"rig {calibration.rig.name}",
            remedy="its accuracy is in the report's table of pairs and in the sigmas of a scan",
        )
    volume, poses = calibration.rig.volume, calibration.rig_from_camera
    cameras = {name: pair.camera for name, pair in calibration.pairs.items()}
    lit = {name for name, pair in calibration.pairs.items() if pair.sheets is not None}
    maps = {}
    for caption, right in PLANES.items():
        points = plane_points(volume, np.array(right), 20.0)
        flat = points.reshape(-1, 3)
        sigma, _ = sigma_at(flat, poses, cameras, calibration.covariance, lit)
        maps[caption] = sigma.reshape(points.shape[:2])
    known = np.concatenate([values[np.isfinite(values)] for values in maps.values()])
    top = float(np.percentile(known, 98)) if known.size else 1.0
    radius = volume.radius_mm
    with charts.style():
        wide = 2.0 * 8.4 * 2.0 * radius / (volume.top_mm - volume.bottom_mm) + 1.6  # inches
        figure, axes = plt.subplots(
            1, len(maps), figsize=(wide, 9.0), sharey=True, layout="constrained"
        )
        for axis, (caption, values) in zip(axes, maps.items(), strict=True):
            axis.set_facecolor("0.78")
            extent = (-radius, radius, volume.bottom_mm, volume.top_mm)
            shown = axis.imshow(values, cmap="turbo", vmin=0.0, vmax=max(top, 1e-6), extent=extent)
            axis.set_title(f"{caption}, mm")
            axis.set_xticks([])
        figure.colorbar(shown, ax=axes, shrink=0.7, label="sigma, mm")
    return charts.png(figure, 900)


def write_sigma_map(calibration: Path, path: Path | None = None) -> Path:
    """Draw the map of a stored calibration and return the picture's path, beside it if none is given.

    Raises BadInput for a path that does not end in .png and where no sigma is known,
    CalibrationFileError.
    """
    path = path or (calibration if calibration.is_dir() else calibration.parent) / MAP_NAME
    if path.suffix.lower() != ".png":
        raise BadInput("the map is drawn as PNG", where=str(path), remedy="name it .png")
    write_bytes(path, draw_sigma_map(load_calibration(calibration)))
    return path


def plane_points(volume: Volume, right: Array, step_mm: float) -> Array:
    """Centres (rows, columns, 3) mm of cells about `step_mm` wide in the upright plane through the
    rig's axis along `right` (3,). Row 0 is the highest."""
    columns = max(round(2.0 * volume.radius_mm / step_mm), 1)
    rows = max(round((volume.top_mm - volume.bottom_mm) / step_mm), 1)
    along = volume.radius_mm * ((2.0 * np.arange(columns) + 1.0) / columns - 1.0)
    share = (np.arange(rows) + 0.5) / rows
    height = volume.top_mm + share * (volume.bottom_mm - volume.top_mm)
    return along[None, :, None] * right + height[:, None, None] * np.array([0.0, 0.0, 1.0])
