"""Pictures of clouds and meshes, drawn without a screen or OpenGL.

Orthographic views side by side in one PNG; meshes by ray casting, clouds by a z-buffer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Bytes
from bodyscan.files.atomic import write_bytes
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.scene import centred_scene
from bodyscan.optional import optional
from bodyscan.outcome import Outcome
from bodyscan.report.canvas import (
    BACKGROUND,
    Scale,
    blue_white_red,
    colour_bar,
    png,
    turbo,
    write_label,
)

FILLED_TINT = (60, 160, 255)  # blue, green, red: orange
WRONG_SIDE = (200, 40, 200)
AZIMUTHS_DEG = {"front": 0.0, "side": 90.0, "back": 180.0}
"""Where the viewer of each view stands, from the subject's front towards its left."""


def draw_scan(cloud: BodyCloud, mesh: BodyMesh, folder: Path) -> Outcome[list[Path]]:
    """The pictures that a scan leaves beside its result: the cloud by photo, sigma and number of
    pairs, and the mesh with its filled faces marked. One that cannot be drawn is noted."""
    pictures = {
        "cloud.png": partial(draw_cloud, cloud, colour="photo"),
        "sigma.png": partial(draw_cloud, cloud, colour="sigma"),
        "pairs.png": partial(draw_cloud, cloud, colour="pairs_seen"),
        "mesh.png": partial(draw_mesh, mesh),
    }
    drawn: list[Path] = []
    notes: list[str] = []
    for name, draw in pictures.items():
        with optional(name, notes.append):
            write_bytes(folder / name, draw())
            drawn.append(folder / name)
    return Outcome(drawn, tuple(notes))


def draw_mesh(
    mesh: BodyMesh, views: Sequence[str] = tuple(AZIMUTHS_DEG), *, height_px: int = 900
) -> bytes:
    """Shaded pictures of a mesh: made-up faces orange, faces seen from their inside magenta."""
    base = np.full((len(mesh.faces), 3), 210, np.uint8)
    base[mesh.filled] = FILLED_TINT
    scene, centre = centred_scene(mesh.vertices, mesh.faces)
    return png(
        _write_name(
            _cast_view(scene, centre, base, _Frame.of(mesh.vertices, view, height_px)), view
        )
        for view in views
    )


def draw_cloud(
    cloud: BodyCloud,
    views: Sequence[str] = tuple(AZIMUTHS_DEG),
    *,
    colour: str = "photo",
    height_px: int = 900,
) -> bytes:
    """Pictures of a cloud; `colour` is photo, sigma or pairs_seen."""
    if colour == "photo":
        return _draw_points(cloud.points, cloud.normals, cloud.colours[:, ::-1], views, height_px)
    if colour == "sigma":
        top = float(np.percentile(cloud.sigma_mm, 98))
        scale, values = Scale(0.0, top, "sigma, mm", turbo()), cloud.sigma_mm
    elif colour == "pairs_seen":
        scale, values = Scale(0.0, 6.0, "pairs", turbo()), cloud.pairs_seen.astype(np.float32)
    else:
        raise ValueError(f"colour is photo, sigma or pairs_seen, not {colour!r}")
    colours = scale.colours(values)
    return _draw_points(cloud.points, cloud.normals, colours, views, height_px, scale)


def draw_deviation(
    points: Array,
    normals: NDArray[np.floating],
    signed_mm: Array,
    views: Sequence[str] = tuple(AZIMUTHS_DEG),
    *,
    limit_mm: float = 1.0,
    height_px: int = 900,
    caption: str = "from truth, mm",
) -> bytes:
    """Points coloured by signed distance to a known surface: blue inside, red outside."""
    scale = Scale(-limit_mm, limit_mm, caption, blue_white_red())
    return _draw_points(points, normals, scale.colours(signed_mm), views, height_px, scale)


def _draw_points(
    points: Array,
    normals: NDArray[np.floating],
    colours: Bytes,
    views: Sequence[str],
    height_px: int,
    scale: Scale | None = None,
) -> bytes:
    """Points (N, 3) with colours (N, 3) blue, green, red; those facing away are left out."""
    dot_mm = _dot_size(points)
    panels = [
        _write_name(
            _splat_view(points, normals, colours, _Frame.of(points, view, height_px), dot_mm), view
        )
        for view in views
    ]
    return png(panels if scale is None else [*panels, colour_bar(scale, height_px)])


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
    def of(points: Array, view: str, height_px: int) -> _Frame:
        axes = _axes(view)
        flat = points @ axes[:2].T
        low, high = flat.min(axis=0) - 20.0, flat.max(axis=0) + 20.0
        # All views of a subject share one scale: that of its greatest extent.
        step = float(np.ptp(points, axis=0).max() + 40.0) / height_px
        middle = (low[1] + high[1]) / 2
        width = int(np.ceil((high[0] - low[0]) / step))
        return _Frame(axes, low[0], middle + step * height_px / 2, step, width, height_px)


def _axes(view: str) -> Array:
    """(3, 3) rows: the picture's right, its up, and the way to the viewer, rig frame."""
    azimuth = np.radians(AZIMUTHS_DEG[view])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    towards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def _write_name(panel: Bytes, view: str) -> Bytes:
    """The panel with the name of its view in its upper left corner."""
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
    points: Array, normals: NDArray[np.floating], colours: Bytes, frame: _Frame, dot_mm: float
) -> Bytes:
    right, up, towards = frame.axes
    front = normals @ towards > 0
    points, colours = points[front], colours[front]
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
