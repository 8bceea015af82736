"""The body model: a cloud, the closed mesh made from it, the regions of its surface; rig frame, mm."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Floats, Indices, Mask
from bodyscan.mesh.topology import compute_face_areas, drop_unused_vertices, label_components

UNSURE, SKIN, HAIR, DARK_CLOTH = range(4)
REGION_NAMES = ("unsure", "skin", "hair", "dark cloth")
"""In the order of the numbers in files."""


@dataclass(frozen=True, eq=False)
class BodyCloud:
    """N points of a body.

    points: (N, 3) float64, mm.
    normals: (N, 3) float32, unit, outward.
    sigma_mm: (N,) float32, standard deviation along the normal.
    colours: (N, 3) uint8, red, green, blue.
    pairs_seen: (N,) uint8, how many pairs measured it.
    regions: (N,) uint8, index into `REGION_NAMES`; None if unknown.
    """

    points: Array
    normals: Floats
    sigma_mm: Floats
    colours: Bytes
    pairs_seen: Bytes
    regions: Bytes | None = None

    @property
    def grey(self) -> Bytes:
        """Grey level (N,) of each point: luma."""
        return np.asarray(cv2.cvtColor(self.colours[None], cv2.COLOR_RGB2GRAY)[0], np.uint8)

    @property
    def region_shares(self) -> dict[str, float] | None:
        """Share of the points in each region, by name."""
        return None if self.regions is None else compute_region_shares(self.regions)

    def subsample(self, step: int) -> BodyCloud:
        """Keep every step-th point."""
        parts: dict[str, Any] = {part.name: getattr(self, part.name) for part in fields(self)}
        return replace(self, **{k: v[::step] for k, v in parts.items() if v is not None})


@dataclass(frozen=True, eq=False)
class BreathAt:
    """Displacements that bring vertices to mean breath."""

    mm: Floats  # (V,) float32, outwards along each vertex's normal
    sigma_mm: Floats  # (V,) float32, their standard deviation


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """A closed triangle mesh with outward faces.

    vertices: (V, 3) float64, mm.
    faces: (F, 3) int64.
    normals: (V, 3) float32, unit, outward.
    colours: (V, 3) uint8.
    sigma_mm: (V,) float32, NaN on filled vertices.
    filled: (F,) bool, faces that no pair measured and that were filled to close the mesh.
    breath: brings the mesh to mean breath, for a person whose motion was estimated.
    regions: (V,) uint8, as of a cloud; unsure on filled vertices.
    """

    vertices: Array
    faces: Indices
    normals: Floats
    colours: Bytes
    sigma_mm: Floats
    filled: Mask
    breath: BreathAt | None = None
    regions: Bytes | None = None

    @cached_property
    def face_regions(self) -> Bytes | None:
        """Region (F,) uint8 of at least two of each face's corners; unsure where filled."""
        if self.regions is None:
            return None
        regions = compute_face_regions(self.regions, self.faces)
        return np.where(self.filled, np.uint8(UNSURE), regions)

    @cached_property
    def filled_share(self) -> float:
        """Share of the surface's area that was filled."""
        area = compute_face_areas(self.vertices, self.faces)
        return float(area[self.filled].sum() / area.sum()) if area.any() else 0.0

    def at_mean_breath(self, sigmas: float = 0.0) -> BodyMesh:
        """Move vertices to mean breath, plus so many standard deviations outwards."""
        if self.breath is None:
            return self
        step = (self.breath.mm + sigmas * self.breath.sigma_mm).astype(np.float64)
        return replace(self, vertices=self.vertices + step[:, None] * self.normals, breath=None)

    def measured_part(self) -> BodyMesh:
        """Remove the filled faces, which leaves an open surface."""
        vertices, faces, used = drop_unused_vertices(self.vertices, self.faces[~self.filled])
        return self.part(vertices, faces, used, np.zeros(len(faces), bool))

    def part(self, vertices: Array, faces: Indices, used: Indices, filled: Mask) -> BodyMesh:
        """Make a mesh with the attributes of vertices `used` (U,), new positions and faces."""
        kept = self.normals[used], self.colours[used], self.sigma_mm[used]
        regions = select_regions(self.regions, used)
        return BodyMesh(vertices, faces, *kept, filled, regions=regions)


def compute_region_shares(regions: Bytes, sizes: Array | None = None) -> dict[str, float]:
    """Compute the share of each region, by name, in regions (N,), weighted by sizes (N,)."""
    counts = np.bincount(regions, sizes, len(REGION_NAMES))
    return dict(zip(REGION_NAMES, (counts / max(counts.sum(), 1e-12)).tolist(), strict=True))


def compute_cover_shares(regions: Bytes | None) -> dict[str, float]:
    """Compute the shares, by name, of regions that are not or may not be skin; empty if unknown.

    Half a percent or less, a few moles and rims, is left out.
    """
    shares = {} if regions is None else compute_region_shares(regions)
    return {k: part for k, part in shares.items() if k != REGION_NAMES[SKIN] and part > 0.005}


def select_regions(regions: Bytes | None, indices: Indices) -> Bytes | None:
    """Select regions by indices (M,) into regions (N,): unsure at -1; None if they are unknown."""
    if regions is None:
        return None
    return np.where(indices >= 0, regions[indices], np.uint8(UNSURE))


def compute_face_regions(regions: Bytes, faces: Indices) -> Bytes:
    """Compute the region (F,) of at least two corners of faces (F, 3), else unsure."""
    a, b, c = regions[faces].T
    return np.where((a == b) | (a == c), a, np.where(b == c, b, np.uint8(UNSURE)))


@dataclass(frozen=True, eq=False)
class FilledPatch:
    """A connected patch of filled faces."""

    area_mm2: float  # of the faces
    centre: Array  # (3,) mm, rig frame


def find_filled_patches(mesh: BodyMesh) -> list[FilledPatch]:
    """Find all filled patches of a mesh, the largest first."""
    filled = mesh.faces[mesh.filled]
    if not len(filled):
        return []
    patch = label_components(filled, len(mesh.vertices))
    area = compute_face_areas(mesh.vertices, filled)
    total = np.bincount(patch, area)
    weighted = mesh.vertices[filled].mean(axis=1) * area[:, None]
    centre = np.stack([np.bincount(patch, column) / total for column in weighted.T], axis=1)
    order = np.argsort(-total, kind="stable")
    return [FilledPatch(float(total[k]), centre[k]) for k in order]
