"""Charts of a calibration: coverage, residuals, the light planes, the sigma that the poses cause in the
scan volume; the rig as a rotatable model."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from pathlib import Path

import cv2
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_bytes
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.light_planes import compute_baseline_angle_tilt
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import ObservedCorners, RigCalibration
from bodyscan.registration.storage import MAP_NAME, load_calibration
from bodyscan.report.charts import BLUE, COLOURS, GREY, INK, RED, grid_of, png, style, svg
from bodyscan.report.model import Strokes, pack
from bodyscan.rig.rig import Volume

DASHES = ("-", "--", "-.", ":")
PLANES = {
    "front: y to the right, z up": (0.0, 1.0, 0.0),
    "side: x to the left, z up": (-1.0, 0.0, 0.0),
}
"""Planes through the rig's axis, by the direction to the picture's right."""


def draw_coverage_chart(calibration: RigCalibration) -> bytes:
    """For each camera: its image, and where each view of a board lay in it."""
    with style():
        figure, axes = grid_of(len(calibration.observed))
        for axis, (name, seen) in zip(axes, calibration.observed.items(), strict=True):
            views = [seen.pixels[seen.target == k] for k in np.unique(seen.target)]
            hulls = [cv2.convexHull(view).reshape(-1, 2) for view in views]
            axis.add_collection(
                PolyCollection(hulls, facecolor=BLUE, alpha=0.16, edgecolor=BLUE, linewidth=0.5)
            )
            axis.plot(*seen.pixels.T, ",", color=INK, alpha=0.5)
            _limit_to_picture(axis, calibration.pairs[name].camera)
            axis.set_title(f"{name}: {len(views)} views", fontsize=9.0)
    return svg(figure)


def draw_residual_chart(calibration: RigCalibration) -> tuple[bytes, float]:
    """For each camera: RMS of the corners' residuals over its image (colour) and their mean
    (arrows). Also returns the factor by which the arrows are magnified."""
    maps = {
        name: _map_residuals(seen, calibration.pairs[name].camera)
        for name, seen in calibration.observed.items()
    }
    rms_known = _gather_finite([rms for rms, _, _ in maps.values()])
    lengths = _gather_finite([np.linalg.norm(mean, axis=-1) for _, mean, _ in maps.values()])
    top = float(np.percentile(rms_known, 98))
    widest = max(calibration.pairs[name].camera.width for name in maps)
    # The longest arrow is about 8 % of the image's width.
    times = float(f"{0.08 * widest / max(float(np.percentile(lengths, 98)), 1e-6):.1g}")
    with style():
        figure, axes = grid_of(len(maps))
        for axis, (name, (rms, mean, middles)) in zip(axes, maps.items(), strict=True):
            camera = calibration.pairs[name].camera
            extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
            shown = axis.imshow(rms, cmap="YlGnBu", vmin=0.0, vmax=top, extent=extent)
            axis.quiver(
                *np.moveaxis(middles, -1, 0),
                *np.moveaxis(times * mean, -1, 0),
                angles="xy",
                scale_units="xy",
                scale=1.0,
                width=0.008,
                color=RED,
            )
            _limit_to_picture(axis, camera)
            axis.set_title(name, fontsize=9.0)
        figure.colorbar(shown, ax=axes, shrink=0.6, label="RMS, px")
    return svg(figure), times


def draw_planes_chart(calibration: RigCalibration) -> bytes:
    """Fig. 6 for every pair: baseline, projection angle and tilt of the light planes over s."""
    colour, dash = choose_line_styles(calibration)
    with style():
        figure, axes = plt.subplots(3, 1, figsize=(9.6, 8.4), sharex=True, constrained_layout=True)
        for name, pair in calibration.pairs.items():
            if pair.sheets is None:
                continue
            s = np.arange(pair.sheets.stripes + 1.0)
            planes = pair.sheets.tangent_planes(s)
            length, angle, tilt = compute_baseline_angle_tilt(planes, pair.sheets.direction)
            for axis, values in zip(
                axes, (length, np.degrees(angle), np.degrees(tilt)), strict=True
            ):
                axis.plot(
                    s, values, color=colour[name], linestyle=dash[name], linewidth=1.2, label=name
                )
        for axis, label in zip(
            axes, ("baseline, mm", "projection angle, degrees", "tilt, degrees"), strict=True
        ):
            axis.set_ylabel(label)
            axis.grid(color=GREY, alpha=0.25, linewidth=0.6)
        axes[-1].set_xlabel("stripe coordinate s")
        handles, labels = axes[0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside right upper", frameon=False)
    return svg(figure)


def count_shared_boards(calibration: RigCalibration) -> Array:
    """Number of boards (P, P) that two pairs saw at the same moment, in the order of `observed`; zero
    on the diagonal."""
    seen = [set(one.target.tolist()) for one in calibration.observed.values()]
    count = np.array([[float(len(a & b)) for b in seen] for a in seen])
    np.fill_diagonal(count, 0.0)
    return count


def choose_line_styles(calibration: RigCalibration) -> tuple[dict[str, str], dict[str, str]]:
    """A colour for the pairs of each pole, and a dash for each pair of a pole."""
    poles: dict[str, list[str]] = defaultdict(list)
    for pair in calibration.rig.pairs:
        poles[pair.pole or pair.name].append(pair.name)
    colour, dash = {}, {}
    for pole, names in enumerate(poles.values()):
        for number, name in enumerate(names):
            colour[name] = COLOURS[pole % len(COLOURS)]
            dash[name] = DASHES[number % len(DASHES)]
    return colour, dash


def _map_residuals(seen: ObservedCorners, camera: Camera) -> tuple[Array, Array, Array]:
    """RMS (rows, columns) and mean (rows, columns, 2) of residuals, px, in 8 rows of 10 cells, and the
    cells' middles; NaN for fewer than three corners."""
    rows, columns = np.linspace(0, camera.height, 9) - 0.5, np.linspace(0, camera.width, 11) - 0.5

    def total(values: Array | None = None) -> Array:
        x, y = seen.pixels.T
        return np.histogram2d(y, x, (rows, columns), weights=values)[0]

    count, residuals = total(), seen.residuals_px.astype(float)
    enough = np.where(count >= 3, count, np.nan)
    rms = np.sqrt(total(np.sum(residuals**2, axis=1)) / enough)
    mean = np.stack([total(values) / enough for values in residuals.T], axis=-1)
    middles = np.meshgrid(columns[:-1] + columns[1:], rows[:-1] + rows[1:])
    return rms, mean, 0.5 * np.stack(middles, axis=-1)


def _limit_to_picture(axis: Axes, camera: Camera) -> None:
    axis.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), aspect="equal")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(True)


def _gather_finite(arrays: list[Array]) -> Array:
    """All known values in some arrays; a single 1 if there are none."""
    known = np.concatenate([array[np.isfinite(array)] for array in arrays])
    return known if known.size else np.ones(1)


def build_rig_model(calibration: RigCalibration) -> dict[str, object]:
    """Build the model for the viewer: cameras' fields of view, boards' outlines, volume and axes."""
    grey, dark = np.array([190, 197, 207], np.uint8), np.array([120, 130, 145], np.uint8)
    colours, _ = choose_line_styles(calibration)
    parts: list[tuple[Array, Bytes]] = []
    for name, pose in calibration.rig_from_camera.items():
        camera = calibration.pairs[name].camera
        right, bottom = camera.width - 0.5, camera.height - 0.5
        corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
        far = pose.apply(220.0 * np.nan_to_num(camera.rays(corners)))
        sides = np.stack([np.broadcast_to(pose.translation, far.shape), far], axis=1)
        rgb = np.frombuffer(bytes.fromhex(colours[name][1:]), np.uint8)
        parts.append((np.concatenate([sides, _close(far)]), rgb))
    for (_, board_name), rig_from_board in calibration.rig_from_board.items():
        board = calibration.rig.board(board_name)
        x, y = board.size_mm
        outline = np.array([[0.0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]])
        parts.append((_close(rig_from_board.apply(outline)), grey))
    volume = calibration.rig.volume
    turn = 2.0 * np.pi * np.arange(48) / 48
    circle = volume.radius_mm * np.stack([np.cos(turn), np.sin(turn), np.zeros(48)], axis=1)
    for height in (volume.bottom_mm, volume.top_mm):
        parts.append((_close(circle + [0.0, 0.0, height]), dark))
    upright = circle[::6, None] + np.array([[0.0, 0, volume.bottom_mm], [0.0, 0, volume.top_mm]])
    parts.append((upright, dark))
    for axis, colour in zip(np.eye(3), ((200, 40, 40), (30, 140, 60), (40, 80, 200)), strict=True):
        parts.append((300.0 * np.stack([np.zeros(3), axis])[None], np.array(colour, np.uint8)))
    ends = np.concatenate([part for part, _ in parts])
    tint = np.repeat([colour for _, colour in parts], [len(part) for part, _ in parts], axis=0)
    labels = [(name, t.translation) for name, t in calibration.rig_from_camera.items()]
    labels += [("x", np.array([340.0, 0.0, 0.0])), ("y", np.array([0.0, 340.0, 0.0]))]
    strokes = Strokes(ends, tint.astype(np.uint8))
    return pack(None, strokes=strokes, labels=labels, view_deg=(20.0, 22.0))


def _close(corners: Array) -> Array:
    """Sides (N, 2, 3) of a polygon (N, 3)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def compute_sigma_at(
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


def draw_sigma_chart(calibration: RigCalibration) -> bytes:
    """Maps of `compute_sigma_at` at x = 0 (front) and y = 0 (side) on one colour scale, as PNG.

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
            "with one pair there is no pose uncertainty to map",
            where=f"rig {calibration.rig.name}",
            remedy="its accuracy is in the report's table of pairs and in the sigmas of a scan",
        )
    volume, poses = calibration.rig.volume, calibration.rig_from_camera
    cameras = {name: pair.camera for name, pair in calibration.pairs.items()}
    lit = {name for name, pair in calibration.pairs.items() if pair.sheets is not None}
    maps = {}
    for caption, right in PLANES.items():
        points = make_plane_points(volume, np.array(right), 20.0)
        flat = points.reshape(-1, 3)
        sigma, _ = compute_sigma_at(flat, poses, cameras, calibration.covariance, lit)
        maps[caption] = sigma.reshape(points.shape[:2])
    known = np.concatenate([values[np.isfinite(values)] for values in maps.values()])
    top = float(np.percentile(known, 98)) if known.size else 1.0
    radius = volume.radius_mm
    with style():
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
    return png(figure, 900)


def write_sigma_map(calibration: Path, path: Path | None = None) -> Path:
    """Draw the position sigma (mm) due to the pairs' poses, in the planes x = 0 and y = 0; return the
    image's path, beside the stored calibration if none is given.

    Raises BadInput for a path that does not end in .png and where no sigma is known,
    CalibrationFileError.
    """
    path = path or (calibration if calibration.is_dir() else calibration.parent) / MAP_NAME
    if path.suffix.lower() != ".png":
        raise BadInput("the map is drawn as PNG", where=str(path), remedy="name it .png")
    write_bytes(path, draw_sigma_chart(load_calibration(calibration)))
    return path


def make_plane_points(volume: Volume, right: Array, step_mm: float) -> Array:
    """Centres (rows, columns, 3) mm of cells about `step_mm` wide in the upright plane through the
    rig's axis along `right` (3,). Row 0 is the highest."""
    columns = max(round(2.0 * volume.radius_mm / step_mm), 1)
    rows = max(round((volume.top_mm - volume.bottom_mm) / step_mm), 1)
    along = volume.radius_mm * ((2.0 * np.arange(columns) + 1.0) / columns - 1.0)
    share = (np.arange(rows) + 0.5) / rows
    height = volume.top_mm + share * (volume.bottom_mm - volume.top_mm)
    return along[None, :, None] * right + height[:, None, None] * np.array([0.0, 0.0, 1.0])
