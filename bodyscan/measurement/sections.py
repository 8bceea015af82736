"""Plane sections of one or several parts of a registered body.

The scan's own surface where it was measured; where it was not, the template's, whose armpits and
crotch are closed as bodies are. So no web between limbs is ever part of a girth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from bodyscan.arrays import Array, Bytes, Mask
from bodyscan.body_model.fitting import BASIS_MM
from bodyscan.body_model.registered import RegisteredBody, vote_on_faces
from bodyscan.mesh.slices import Loop, MeshSlicer, compute_hull_perimeter

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Section:
    """A section of some parts by a plane."""

    points: Array  # (N, 2) mm, in the plane, the two ends of each segment
    observed: Mask  # (N,), whether the scan measured them
    away_mm: Array  # (N,), to the closest measured vertex; 0 for those
    axes: Array  # (3, 3), the plane's two axes and its normal, body frame
    level_mm: float  # along the normal
    measured_sigma_mm: float  # standard deviation of its tape girth by what the scan measured

    @cached_property
    def tape_mm(self) -> float:
        """Girth as a tape runs: the convex hull's perimeter."""
        return compute_hull_perimeter(self.points)

    @cached_property
    def tape_measured(self) -> float:
        """Share of the tape that touches measured skin or spans hollows between it: what was not
        measured and lies within BASIS_MM of the tape might touch it."""
        ends = self.points.reshape(-1, 2, 2)[~self.observed[::2]]
        hull = ConvexHull(self.points)
        inside = -(hull.equations[:, :2] @ ends.mean(axis=1).T + hull.equations[:, 2:]).max(axis=0)
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        return max(0.0, 1.0 - float(lengths[inside < BASIS_MM].sum()) / float(hull.area))

    @cached_property
    def unseen_sigma_mm(self) -> float:
        """Standard deviation of the tape girth by what was not measured: what it grows by where that
        stands out by as much as the template's surface is off, left and right by themselves.

        That is 2 mm (RMS) up to 40 mm from measured skin, on trunks and limbs of 18 random bodies and
        of the two people of an independent renderer; farther away, what its shapes lack.
        """
        sigma_mm = np.where(self.away_mm < 40.0, 2.0, BASIS_MM) * ~self.observed
        along = np.repeat(np.diff(self.points.reshape(-1, 2, 2), axis=1)[:, 0], 2, axis=0)
        outward = np.column_stack([along[:, 1], -along[:, 0]])  # the body is on the left
        outward /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        left = self.points[:, 1] > self.points[:, 1].mean()
        sides = [self.points + (sigma_mm * side)[:, None] * outward for side in (left, ~left)]
        return float(np.linalg.norm([compute_hull_perimeter(one) - self.tape_mm for one in sides]))

    @property
    def positions(self) -> Array:
        """Its points (N, 3), mm, body frame."""
        level = np.full(len(self.points), self.level_mm)
        return np.column_stack([self.points, level]) @ self.axes


@dataclass(frozen=True, eq=False)
class BodySections:
    """Cuts a registered body. slicers: by the plane's normal, made when they are needed."""

    body: RegisteredBody
    slicers: dict[tuple[float, ...], tuple[Array, MeshSlicer, MeshSlicer]] = field(
        default_factory=dict
    )

    @cached_property
    def noise_mm(self) -> Array:
        """(N,) sigma of the scan's vertices; the median where nothing was measured."""
        noise = self.body.mesh.sigma_mm.astype(np.float64)
        noise[~np.isfinite(noise)] = np.nanmedian(noise)
        return noise

    @cached_property
    def _face_parts(self) -> tuple[Bytes, Bytes]:
        """Parts of the faces of the scan, and of the template."""
        template = self.body.fitted.template
        return (
            vote_on_faces(self.body.parts[self.body.mesh.faces]),
            vote_on_faces(template.parts[template.faces]),
        )

    def cut(self, normal: Array, level_mm: float, parts: str | Sequence[str]) -> Section | None:
        """Section of the loop that has most of these parts, by the plane square to a normal (3,);
        None if none has."""
        axes, scan, template = self._find_slicers(normal)
        names = [parts] if isinstance(parts, str) else parts
        wanted = [self.body.fitted.template.part_names.index(name) for name in names]
        of_scan, of_template = self._face_parts
        scanned = _select(scan.slice(level_mm), of_scan, wanted)
        whole = _select(template.slice(level_mm), of_template, wanted) or scanned
        if whole is None:
            return None
        points, noise, breath = np.zeros((0, 2)), 0.0, 0.0
        if scanned is not None and (scanned[1] & scanned[0].measured).any():
            loop, mine = scanned[0], scanned[1] & scanned[0].measured
            points = loop.segments[mine].reshape(-1, 2)
            corners = self.body.mesh.faces[loop.faces[mine]]
            noise = float(self.noise_mm[corners].mean())
            breath = float(self.body.breath_sigma_mm[corners].mean())
        loop, mine = whole
        known = mine & loop.measured if len(points) else np.zeros_like(mine)
        closed = loop.segments[mine & ~known].reshape(-1, 2)
        positions = np.column_stack([closed, np.full(len(closed), level_mm)]) @ axes
        away_mm = self.body.measured_tree.query(positions)[0]
        return Section(
            np.concatenate([closed, points]),
            np.arange(len(closed) + len(points)) >= len(closed),
            np.append(away_mm, np.zeros(len(points))),
            axes,
            level_mm,
            # Noise is correlated over a quarter of the girth; breath all around it.
            np.pi * float(np.hypot(noise, 2.0 * breath)),
        )

    def _find_slicers(self, normal: Array) -> tuple[Array, MeshSlicer, MeshSlicer]:
        key = tuple(normal.tolist())
        if key not in self.slicers:
            across = np.cross(normal, [1.0, 0.0, 0.0])
            across /= np.linalg.norm(across)
            axes = np.stack([np.cross(across, normal), across, normal])
            mesh, fitted = self.body.mesh, self.body.fitted
            faces = fitted.template.faces
            unseen = np.asarray(~self.body.measured[faces].all(axis=1))
            self.slicers[key] = (
                axes,
                MeshSlicer(self.body.vertices @ axes.T, mesh.faces, mesh.filled),
                MeshSlicer(fitted.vertices @ axes.T, faces, unseen),
            )
        return self.slicers[key]


def _select(
    loops: Sequence[Loop], face_parts: Bytes, wanted: Sequence[int]
) -> tuple[Loop, Mask] | None:
    """The loop with most of the wanted parts, and which segments are theirs; None if that is a rim. The
    other thigh has some of the trunk above it, so the first loop that has any may be wrong."""
    shares = [np.isin(face_parts[loop.faces], wanted) for loop in loops]
    lengths = [loop.lengths[mine].sum() for loop, mine in zip(loops, shares, strict=True)]
    best = int(np.argmax(lengths)) if lengths else 0
    if not lengths or lengths[best] <= 50.0:
        return None
    # A limb by itself has some faces named after its neighbours.
    if lengths[best] > 0.8 * loops[best].girth_mm:
        shares[best][:] = True
    return loops[best], shares[best]
