"""Pictures of clouds and meshes, orthographic views side by side, drawn without screen or OpenGL."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Bytes, Floats, Indices
from bodyscan.files.atomic import write_bytes
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.body_frame import find_body_frame
from bodyscan.mesh.depth_buffer import find_nearest_faces, find_nearest_points
from bodyscan.optional import optional
from bodyscan.outcome import Outcome

FILLED_TINT = (60, 160, 255)  # blue, green, red: orange
BACKGROUND, INK, UNKNOWN = (250, 250, 250), (40, 40, 40), (128, 128, 128)
Pictures = Outcome[dict[str, bytes]]
"""PNG files by name; those that could not be drawn are noted."""
AZIMUTHS_DEG = {"front": 0.0, "side": 90.0, "back": 180.0}
"""Where the viewer of each view stands, from the subject's front towards its left."""


def draw_pictures(body: BodyCloud | BodyMesh) -> Pictures:
    """Draw a cloud by photo, sigma and number of pairs, or a mesh with its filled faces marked;
    pictures that fail are noted."""
    drawn: dict[str, bytes] = {}
    notes: list[str] = []
    tasks: dict[str, Callable[[], bytes]] = {}
    if isinstance(body, BodyMesh):
        tasks = {"mesh.png": partial(draw_mesh, body)}
    else:
        with optional("pictures of the cloud", notes.append):
            visible = VisiblePoints.from_points(body.points, body.normals)
            colours = {"cloud.png": "photo", "sigma.png": "sigma", "pairs.png": "pairs_seen"}
            tasks = {name: partial(draw_cloud, body, visible, c) for name, c in colours.items()}
    for name, draw in tasks.items():
        with optional(name, notes.append):
            drawn[name] = draw()
    return Outcome(drawn, tuple(notes))


def write_pictures(pictures: Iterable[Pictures], folder: Path) -> Outcome[list[Path]]:
    """Write a scan's pictures beside its result. One that could not be drawn is noted; OSError if
    one cannot be written: a full disk must not decide which files a result has."""
    written, notes = list[Path](), list[str]()
    for some in pictures:
        notes += some.notes
        for name, content in some.value.items():
            write_bytes(folder / name, content)
            written.append(folder / name)
    return Outcome(written, tuple(notes))


def draw_mesh(
    mesh: BodyMesh, views: Sequence[str] = tuple(AZIMUTHS_DEG), *, height_px: int = 900
) -> bytes:
    """Shaded pictures of a mesh: filled faces orange, faces seen from their inside magenta."""
    base = np.full((len(mesh.faces), 3), 210, np.uint8)
    base[mesh.filled] = FILLED_TINT
    frames = _make_frames(mesh.vertices, views, height_px)
    return png([_draw_faces(mesh, base, frame) for frame in frames], views)


@dataclass(frozen=True, eq=False)
class Callout:
    """A polyline (N, 3) mm, rig frame, on a picture, with a label and a colour (blue, green, red)."""

    text: str
    path: Array
    colour: tuple[int, int, int]


def draw_callouts(mesh: BodyMesh, callouts: Mapping[str, Sequence[Callout]]) -> bytes:
    """Shaded pictures of a mesh with lines over them by view, each labelled in its side's margin."""
    base = np.full((len(mesh.faces), 3), 225, np.uint8)
    height_px, wide, panels = 1100, 250, []  # wide: of a margin
    frames = _make_frames(mesh.vertices, tuple(callouts), height_px)
    for view, frame in zip(callouts, frames, strict=True):
        margin = np.full((height_px, wide, 3), BACKGROUND, np.uint8)
        canvas = np.hstack([margin, _draw_faces(mesh, base, frame), margin])
        ends: dict[bool, list[tuple[float, float, Callout]]] = {False: [], True: []}
        for callout in callouts[view]:
            pixels = frame.project(callout.path)[:, :2] + [wide, 0.0]
            sixteenths = np.rint(pixels * 16.0).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(canvas, [sixteenths], False, callout.colour, 2, cv2.LINE_AA, shift=4)
            at_right = bool(pixels[:, 0].mean() >= canvas.shape[1] / 2)
            column, row = pixels[int(np.argmax(pixels[:, 0] if at_right else -pixels[:, 0]))]
            ends[at_right].append((float(row), float(column), callout))
        _label_margin(canvas, ends[False], wide - 14, at_right=False)
        _label_margin(canvas, ends[True], canvas.shape[1] - wide + 14, at_right=True)
        panels.append(canvas)
    return png(panels, tuple(callouts))


def _label_margin(
    canvas: Bytes, ends: list[tuple[float, float, Callout]], edge: int, *, at_right: bool
) -> None:
    """Write labels beside a column, a line apart, each joined to its line's end (row, column)."""
    ends.sort(key=lambda end: end[:2])
    rows, step = [row for row, _, _ in ends], 17.0
    for k in range(1, len(rows)):  # down from the one above, then up from the bottom
        rows[k] = max(rows[k], rows[k - 1] + step)
    below = canvas.shape[0] - 8.0 + step
    for k in reversed(range(len(rows))):
        below = rows[k] = min(rows[k], below - step)
    for place, (row, column, callout) in zip(rows, ends, strict=True):
        (width, _), _ = cv2.getTextSize(callout.text, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
        knee = (edge - 4 if at_right else edge + 4, round(place) - 4)
        joined = np.array([[round(column), round(row)], knee], np.int32)
        cv2.polylines(canvas, [joined], False, UNKNOWN, 1, cv2.LINE_AA)
        write_label(canvas, callout.text, (edge if at_right else edge - width, round(place)))


@dataclass(frozen=True, eq=False)
class VisiblePoints:
    """The point that each pixel of some views shows: the nearest of those that face the viewer."""

    views: tuple[str, ...]
    numbers: tuple[Indices, ...]  # an image (H, W) a view; -1 where there is none

    @staticmethod
    def from_points(
        points: Array,
        normals: NDArray[np.floating],
        views: Sequence[str] = tuple(AZIMUTHS_DEG),
        *,
        height_px: int = 900,
    ) -> VisiblePoints:
        """Of points (N, 3) with normals (N, 3), mm, rig frame."""
        dot_mm, frames = _choose_dot_size(points), _make_frames(points, views, height_px)
        numbers = tuple(_find_visible(points, normals, frame, dot_mm) for frame in frames)
        return VisiblePoints(tuple(views), numbers)

    def draw(self, colours: Bytes, *more: Bytes) -> bytes:
        """A picture of all views, by colours (N, 3) blue, green, red; more panels go to the right."""
        coloured = np.vstack([colours, np.array([BACKGROUND], np.uint8)])  # which -1 selects
        return png([*(coloured[number] for number in self.numbers), *more], self.views)

    def draw_values(self, values: NDArray[np.floating], scale: Scale) -> bytes:
        """A picture by a number for each point, with the scale's bar."""
        return self.draw(scale.colours(values), draw_colour_bar(scale, len(self.numbers[0])))


def draw_cloud(cloud: BodyCloud, visible: VisiblePoints, colour: str = "photo") -> bytes:
    """Picture of a cloud; `colour` is photo, sigma or pairs_seen."""
    if colour == "photo":
        return visible.draw(cloud.colours[:, ::-1])
    if colour == "sigma":
        limit = float(np.percentile(cloud.sigma_mm[::10], 98))
        return visible.draw_values(cloud.sigma_mm, Scale(0.0, limit, "sigma, mm", turbo()))
    if colour == "pairs_seen":
        pairs = cloud.pairs_seen.astype(np.float32)
        return visible.draw_values(pairs, Scale(0.0, 6.0, "pairs", turbo()))
    raise ValueError(f"colour is photo, sigma or pairs_seen, not {colour!r}")


@dataclass(frozen=True)
class _Frame:
    """Which part of the picture plane a view shows, and at what scale."""

    axes: Array
    left: float
    top: float
    step_mm: float
    width: int
    height: int

    def project(self, points: Array) -> Floats:
        """Column, row and depth (mm, from the middle) (N, 3) of points (N, 3)."""
        right, up, towards = self.axes
        projected = np.empty((len(points), 3), np.float32)
        projected[:, 0] = (points @ right - self.left) / self.step_mm - 0.5
        projected[:, 1] = (self.top - points @ up) / self.step_mm - 0.5
        projected[:, 2] = -(points @ towards)
        return projected


def _make_frames(points: Array, views: Sequence[str], height_px: int) -> list[_Frame]:
    """Frames of a subject's views, all with the scale of its greatest extent; what faces x is front
    where no feet tell which way the subject faces."""
    low, high = points.min(axis=0), points.max(axis=0)
    step = float((high - low).max() + 40.0) / height_px
    middle = 0.5 * (low[2] + high[2])
    body = find_body_frame(points[:: max(1, len(points) // 50_000)])
    frames = []
    for view in views:
        axes = _make_axes(view) @ body.view_axes.T
        across = points @ axes[0]
        ends = np.array([across.min(), across.max()])
        width = int(np.ceil((np.ptp(ends) + 40.0) / step))
        top = middle + step * height_px / 2
        frames.append(_Frame(axes, float(ends.min()) - 20.0, top, step, width, height_px))
    return frames


def _make_axes(view: str) -> Array:
    """Rows (3, 3): the picture's right, its up, and the direction to the viewer, body frame."""
    azimuth = np.radians(AZIMUTHS_DEG[view])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    towards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def _draw_faces(mesh: BodyMesh, base: Bytes, frame: _Frame) -> Bytes:
    """Draw faces in their colours (F, 3), shaded by how they face the viewer."""
    number = find_nearest_faces(frame.project(mesh.vertices), mesh.faces, frame.height, frame.width)
    hit = number >= 0
    face = number[hit]
    first, second, third = np.moveaxis(mesh.vertices[mesh.faces[face]], 1, 0)
    normals = np.cross(second - first, third - first)
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    facing = normals @ frame.axes[2] / length
    colours = np.where((facing < 0)[:, None], (200, 40, 200), base[face])
    canvas = np.full((*number.shape, 3), BACKGROUND, np.uint8)
    canvas[hit] = colours * (0.25 + 0.75 * np.abs(facing))[:, None]
    return canvas


def _find_visible(
    points: Array, normals: NDArray[np.floating], frame: _Frame, dot_mm: float
) -> Indices:
    """Number (H, W) of the point that a pixel shows if points are squares of dot_mm; -1 for none."""
    front = np.flatnonzero(normals @ frame.axes[2].astype(normals.dtype) > 0)
    size = max(1, int(np.ceil(dot_mm / frame.step_mm)))
    projected = frame.project(points.take(front, axis=0))
    nearest = find_nearest_points(projected, size, frame.height, frame.width)
    return np.append(front, -1)[nearest]


def _choose_dot_size(points: Array) -> float:
    """Size to draw a point, mm, so that a surface shows no holes: four times the median gap."""
    if len(points) < 2:
        return 0.0
    height = points[:, 2]
    level = np.abs(height - np.median(height))
    # A slice is enough, and its tree is built at once: of a body 40 mm of the trunk.
    count = min(20_000, len(points))
    slice_ = points[np.argpartition(level, count - 1)[:count]]
    gaps = np.asarray(cKDTree(slice_).query(slice_[:: max(1, count // 2000)], k=2)[0])[:, 1]
    return 4.0 * float(np.median(gaps))


@dataclass(frozen=True)
class Scale:
    """A colour for every number between two ends, with a caption for its bar."""

    low: float
    high: float
    caption: str
    table: Bytes  # (256, 3)

    def colours(self, values: NDArray[np.floating]) -> Bytes:
        """Colours (N, 3) of values (N,); clipped to the ends, grey for NaN."""
        share = (np.nan_to_num(values) - self.low) / (self.high - self.low)
        colours = self.table[np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)]
        return np.where(np.isfinite(values)[:, None], colours, UNKNOWN).astype(np.uint8)


def draw_colour_bar(scale: Scale, height_px: int) -> Bytes:
    """Draw a colour bar with the numbers at its ends and middle beside it, and its caption."""
    panel = np.full((height_px, 130, 3), BACKGROUND, np.uint8)
    top, bottom = height_px // 6, height_px - height_px // 6
    ramp = scale.table[np.linspace(255, 0, bottom - top).astype(np.uint8)]
    panel[top:bottom, 20:50] = ramp[:, None]
    for value, row in zip(
        np.linspace(scale.low, scale.high, 3), (bottom, (top + bottom) // 2, top), strict=True
    ):
        panel[row, 50:54] = INK
        write_label(panel, f"{value:.2g}", (58, row + 5))
    write_label(panel, scale.caption, (8, top - 20))
    return panel


def write_label(panel: Bytes, text: str, corner: tuple[int, int]) -> None:
    """Write text with its lower left corner at (column, row)."""
    cv2.putText(panel, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)


def turbo() -> Bytes:
    """Return the turbo colour map: (256, 3) blue, green, red."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_TURBO)).reshape(256, 3)


def png(panels: Sequence[Bytes], views: Sequence[str]) -> bytes:
    """Encode panels of equal height, side by side, as PNG, each with its view's name if it has one."""
    for panel, view in zip(panels, views, strict=False):
        write_label(panel, view, (6, 16))
    return cv2.imencode(".png", np.concatenate(panels, axis=1))[1].tobytes()
