"""How well the pairs' poses are known at each place of the scan volume, as a picture."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_bytes
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import MAP_NAME, load_calibration
from bodyscan.report.canvas import (
    BACKGROUND,
    INK,
    Scale,
    colour_bar,
    png,
    turbo,
    write_label,
)
from bodyscan.rig.rig import Volume

STEP_MM = 20.0
MARGIN_PX = 60
UNSEEN = (200, 200, 200)
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

    alone: pairs that measure what no other sees, with their projectors.

    A point is the mean of what the pairs that see it measure, so only their common error, and a
    share of their independent errors, remains. Poses alone: no stripe noise, no swaying subject.
    NaN where nothing is measured: a camera without a projector tells depth only with another.
    """
    seen = np.stack(
        [
            is_in_image(cameras[name], rig_from_camera[name].inverse().apply(points))
            if name in cameras
            else np.zeros(len(points), bool)
            for name in covariance.names
        ],
        axis=1,
    )
    count = seen.sum(axis=1)
    masks, which = np.unique(seen, axis=0, return_inverse=True)
    shares = masks / np.maximum(masks.sum(axis=1, keepdims=True), 1)
    pairs = len(covariance.names)
    blocks = covariance.matrix.reshape(pairs, 6, pairs, 6)
    motions = np.einsum("mp,piqj,mq->mij", shares, blocks, shares, optimize=True)
    jacobian = twist_jacobian(points)
    variance = np.einsum("nki,nij,nkj->n", jacobian, motions[which.reshape(-1)], jacobian)
    lit = seen[:, [name in alone for name in covariance.names]].any(axis=1)
    measured = lit | (count > 1)
    return np.where(measured, np.sqrt(np.maximum(variance, 0.0)), np.nan), count


def why_no_sigma(calibration: RigCalibration) -> tuple[str, str] | None:
    """Why a map of `sigma_at` would say nothing, and what to do; None if there is one to draw."""
    unknown = [name for name, pair in calibration.pairs.items() if pair.quality.unjudged]
    if unknown:
        return (
            f"nobody said how exact the imported calibration of {', '.join(unknown)} is",
            "if you know it, say it when you import (`import --sigma-px`); to find out, show the rig "
            "a board (`check-calibration`), or calibrate it with bodyscan (`calibrate-rig`)",
        )
    if len(calibration.pairs) == 1:
        return (
            "a single pair has no pose that could be wrong: the rig frame is fixed to it",
            "how exact it measures is told by the report's table of pairs, and by the sigmas of a scan",
        )
    return None


def draw_sigma_map(calibration: RigCalibration, *, height_px: int = 900) -> bytes:
    """Maps of `sigma_at` in the planes x = 0 (front) and y = 0 (side) on one colour scale, as PNG.

    Light grey where nothing is measured. Raises BadInput if no sigma is known (`why_no_sigma`).
    """
    why = why_no_sigma(calibration)
    if why is not None:
        raise BadInput(why[0], where=f"rig {calibration.rig.name}", remedy=why[1])
    volume, placed = calibration.rig.volume, calibration.rig_from_camera
    cameras = {name: pair.camera for name, pair in calibration.pairs.items()}
    lit = {name for name, pair in calibration.pairs.items() if pair.sheets is not None}
    maps = {}
    for caption, right in PLANES.items():
        points = plane_points(volume, np.array(right), STEP_MM)
        flat = points.reshape(-1, 3)
        sigma, _ = sigma_at(flat, placed, cameras, calibration.covariance, lit)
        maps[caption] = sigma.reshape(points.shape[:2])
    known = np.concatenate([values[np.isfinite(values)] for values in maps.values()])
    top = float(np.percentile(known, 98)) if known.size else 1.0
    scale = Scale(0.0, max(top, 1e-6), "sigma, mm", turbo())
    panels = [_panel(values, scale, caption, volume, height_px) for caption, values in maps.items()]
    return png([*panels, colour_bar(scale, height_px)])


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


def _panel(values: Array, scale: Scale, caption: str, volume: Volume, height_px: int) -> Bytes:
    """One map with its caption and a height every half metre."""
    tall = height_px - 2 * MARGIN_PX
    px_per_mm = tall / (volume.top_mm - volume.bottom_mm)
    wide = max(round(2.0 * volume.radius_mm * px_per_mm), 1)
    colours = scale.colours(values.ravel().astype(np.float32)).reshape(*values.shape, 3)
    colours[~np.isfinite(values)] = UNSEEN
    map_ = cv2.resize(colours, (wide, tall), interpolation=cv2.INTER_NEAREST)
    panel = np.full((height_px, wide + 2 * MARGIN_PX, 3), BACKGROUND, np.uint8)
    panel[MARGIN_PX : MARGIN_PX + tall, MARGIN_PX : MARGIN_PX + wide] = map_
    for height in np.arange(0.0, volume.top_mm, 500.0):
        row = round(MARGIN_PX + (volume.top_mm - height) * px_per_mm)
        if row <= MARGIN_PX + tall + 5:
            write_label(panel, f"{height:.0f}", (8, row))
            cv2.line(panel, (MARGIN_PX - 8, row), (MARGIN_PX - 2, row), INK, 1)
    write_label(panel, f"{caption}, mm", (MARGIN_PX, MARGIN_PX - 20))
    return panel
