"""Pictures of clouds and meshes, drawn without a screen or OpenGL.

Orthographic views side by side in one PNG; meshes by ray casting, clouds by a z-buffer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Bytes
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.scene import centred_scene
from bodyscan.report.canvas import (
    BACKGROUND,
    Scale,
    blue_white_red,
    colour_bar,
    save_panels,
    turbo,
    write_label,
)

FILLED_TINT = (60, 160, 255)  # blue, green, red: orange
WRONG_SIDE = (200, 40, 200)


@dataclass(frozen=True)
class View:
    """Where the viewer stands: azimuth from the subject's front towards its left, degrees.

    `around_mm` and `extent_mm` zoom in on a detail: a square of that size about that point.
    """

    azimuth_deg: float
    elevation_deg: float = 0.0
    around_mm: tuple[float, float, float] | None = None
    extent_mm: float | None = None

    @property
    def axes(self) -> Array:
        """(3, 3) rows: the picture's right, its up, and the way to the viewer, rig frame."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        towards = np.cos(elevation) * flat + np.array([0.0, 0.0, np.sin(elevation)])
        return np.stack([right, np.cross(towards, right), towards])


VIEWS = {
    "front": View(0.0),
    "left": View(90.0),
    "side": View(90.0),
    "back": View(180.0),
    "right": View(270.0),
    "above": View(0.0, 89.9),
    "below": View(0.0, -89.9),
}


def draw_scan(cloud: BodyCloud, mesh: BodyMesh, folder: Path) -> list[Path]:
    """The pictures that a scan leaves beside its result: the cloud by photo, sigma and number of
    pairs, and the mesh with its filled faces marked."""
    paths = [folder / f"{name}.png" for name in ("cloud", "sigma", "pairs", "mesh")]
    draw_cloud(cloud, paths[0], colour="photo")
    draw_cloud(cloud, paths[1], colour="sigma")
    draw_cloud(cloud, paths[2], colour="pairs_seen")
    draw_mesh(mesh, paths[3], colour="filled")
    return paths


def draw_mesh(
    mesh: BodyMesh,
    path: Path,
    views: Sequence[str | View] = ("front", "side", "back"),
    *,
    colour: str = "filled",
    height_px: int = 900,
) -> None:
    """Shaded pictures of a mesh; `colour` is filled (made-up faces orange), photo or plain.

    Faces seen from their inside are magenta.
    """
    base = np.full((len(mesh.faces), 3), 210, np.uint8)
    if colour == "filled":
        base[mesh.filled] = FILLED_TINT
    elif colour == "photo":
        base = mesh.colours[mesh.faces[:, 0], ::-1]
    elif colour != "plain":
        raise ValueError(f"colour is filled, photo or plain, not {colour!r}")
    scene, centre = centred_scene(mesh.vertices, mesh.faces)
    panels = [
        _write_name(
            _cast_view(scene, centre, base, _Frame.of(mesh.vertices, _view(view), height_px)), view
        )
        for view in views
    ]
    save_panels(path, panels)


def draw_cloud(
    cloud: BodyCloud,
    path: Path,
    views: Sequence[str | View] = ("front", "side", "back"),
    *,
    colour: str = "photo",
    height_px: int = 900,
) -> None:
    """Pictures of a cloud; `colour` is photo, sigma, pairs_seen or plain (shaded)."""
    if colour == "photo":
        draw_points(cloud.points, cloud.normals, cloud.colours[:, ::-1], path, views, height_px)
        return
    if colour == "plain":
        grey = np.full((len(cloud.points), 3), 210, np.uint8)
        draw_points(cloud.points, cloud.normals, grey, path, views, height_px, shaded=True)
        return
    if colour == "sigma":
        top = float(np.percentile(cloud.sigma_mm, 98))
        scale, values = Scale(0.0, top, "sigma, mm", turbo()), cloud.sigma_mm
    elif colour == "pairs_seen":
        scale, values = Scale(0.0, 6.0, "pairs", turbo()), cloud.pairs_seen.astype(np.float32)
    else:
        raise ValueError(f"colour is photo, plain, sigma or pairs_seen, not {colour!r}")
    colours = scale.colours(values)
    draw_points(cloud.points, cloud.normals, colours, path, views, height_px, scale=scale)


def draw_deviation(
    points: Array,
    signed_mm: Array,
    path: Path,
    limit_mm: float = 1.0,
    views: Sequence[str | View] = ("front", "side", "back"),
    *,
    normals: NDArray[np.floating] | None = None,
    height_px: int = 900,
    caption: str = "from truth, mm",
) -> None:
    """Points coloured by signed distance to a known surface: blue inside, red outside."""
    scale = Scale(-limit_mm, limit_mm, caption, blue_white_red())
    colours = scale.colours(signed_mm)
    draw_points(points, normals, colours, path, views, height_px, scale=scale)


def draw_points(
    points: Array,
    normals: NDArray[np.floating] | None,
    colours: Bytes,
    path: Path,
    views: Sequence[str | View],
    height_px: int,
    *,
    scale: Scale | None = None,
    shaded: bool = False,
) -> None:
    """Points (N, 3) with colours (N, 3) blue, green, red; those facing away are left out."""
    dot_mm = _dot_size(points)
    panels = []
    for view in views:
        frame = _Frame.of(points, _view(view), height_px)
        panels.append(
            _write_name(_splat_view(points, normals, colours, frame, dot_mm, shaded), view)
        )
    save_panels(path, panels if scale is None else [*panels, colour_bar(scale, height_px)])


@dataclass(frozen=True)
class _Frame:
    """A view's picture: which part of the picture plane it shows, and how large."""

    axes: Array
    left: float
    top: float
    step_mm: float
    width: int
    height: int

    @staticmethod
    def of(points: Array, view: View, height_px: int) -> _Frame:
        axes = view.axes
        if view.around_mm is not None and view.extent_mm is not None:
            x, y, _ = axes @ np.array(view.around_mm)
            half = view.extent_mm / 2
            step = view.extent_mm / height_px
            return _Frame(axes, x - half, y + half, step, height_px, height_px)
        flat = points @ axes[:2].T
        low, high = flat.min(axis=0) - 20.0, flat.max(axis=0) + 20.0
        # All views of a subject share one scale: that of its greatest extent.
        step = float(np.ptp(points, axis=0).max() + 40.0) / height_px
        middle = (low[1] + high[1]) / 2
        width = int(np.ceil((high[0] - low[0]) / step))
        return _Frame(axes, low[0], middle + step * height_px / 2, step, width, height_px)


def _view(view: str | View) -> View:
    return VIEWS[view] if isinstance(view, str) else view


def _write_name(panel: Bytes, view: str | View) -> Bytes:
    """The panel with the name of its view, if it has one, in its upper left corner."""
    if isinstance(view, str):
        write_label(panel, view, (6, 16))
    return panel


def _cast_view(
    scene: o3d.t.geometry.RaycastingScene, centre: Array, base: Bytes, frame: _Frame
) -> Bytes:
    right, up, towards = frame.axes
    columns = frame.left + frame.step_mm * (np.arange(frame.width) + 0.5)
    rows = frame.top - frame.step_mm * (np.arange(frame.height) + 0.5)
    origins = columns[None, :, None] * right + rows[:, None, None] * up
    origins = origins - centre + (5000.0 + centre @ towards) * towards
    directions = np.broadcast_to(-towards, origins.shape)
    rays = np.concatenate([origins, directions], axis=-1).astype(np.float32)
    cast = scene.cast_rays(o3d.core.Tensor(rays))
    face = cast["primitive_ids"].numpy().astype(np.int64)
    hit = np.isfinite(cast["t_hit"].numpy())
    facing = cast["primitive_normals"].numpy() @ towards
    colours = np.where((facing < 0)[..., None], WRONG_SIDE, base[np.where(hit, face, 0)])
    shade = (0.25 + 0.75 * np.abs(facing))[..., None]
    return np.where(hit[..., None], colours * shade, BACKGROUND).astype(np.uint8)


def _splat_view(
    points: Array,
    normals: NDArray[np.floating] | None,
    colours: Bytes,
    frame: _Frame,
    dot_mm: float,
    shaded: bool,
) -> Bytes:
    right, up, towards = frame.axes
    facing = np.ones(len(points)) if normals is None else normals @ towards
    front = facing > 0
    points, colours, facing = points[front], colours[front], facing[front]
    if shaded:
        colours = (colours * (0.25 + 0.75 * facing[:, None])).astype(np.uint8)
    columns = np.floor((points @ right - frame.left) / frame.step_mm).astype(np.int64)
    rows = np.floor((frame.top - points @ up) / frame.step_mm).astype(np.int64)
    order = np.argsort(points @ towards)  # far to near: the nearest is written last
    size = max(1, int(np.ceil(dot_mm / frame.step_mm)))
    spread = np.arange(size) - size // 2
    canvas = np.full((frame.height, frame.width, 3), BACKGROUND, np.uint8)
    shape = (len(order), size, size)
    r = np.broadcast_to((rows[order, None] + spread)[:, :, None], shape).ravel()
    c = np.broadcast_to((columns[order, None] + spread)[:, None, :], shape).ravel()
    inside = (r >= 0) & (r < frame.height) & (c >= 0) & (c < frame.width)
    source = np.broadcast_to(order[:, None, None], shape).ravel()[inside]
    canvas[r[inside], c[inside]] = colours[source]
    return canvas


def _dot_size(points: Array) -> float:
    """How far to spread a point, mm, so that a surface shows no holes: four times the usual gap."""
    if len(points) < 2:
        return 0.0
    some = points[:: max(1, len(points) // 2000)]
    gaps = np.asarray(cKDTree(points).query(some, k=2)[0])[:, 1]
    return 4.0 * float(np.median(gaps))
