"""The body model: a cloud, and the closed mesh made from it, in the rig frame, mm."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from bodyscan.arrays import Array, Bytes, Floats, Indices, Mask
from bodyscan.mesh.regions import UNSURE, of_faces, regions_at, shares
from bodyscan.mesh.topology import drop_unused_vertices, face_areas


@dataclass(frozen=True, eq=False)
class BodyCloud:
    """N points of a body.

    points: (N, 3) float64, mm.
    normals: (N, 3) float32, unit, outward.
    sigma_mm: (N,) float32, standard deviation along the normal.
    colours: (N, 3) uint8, red, green, blue.
    pairs_seen: (N,) uint8, how many pairs measured it.
    regions: (N,) uint8, index into `regions.NAMES`; None if unknown.
    """

    points: Array
    normals: Floats
    sigma_mm: Floats
    colours: Bytes
    pairs_seen: Bytes
    regions: Bytes | None = None

    @property
    def region_shares(self) -> dict[str, float] | None:
        """Of the points, how many are of each region."""
        return None if self.regions is None else shares(self.regions)

    def every(self, step: int) -> BodyCloud:
        """Every step-th point."""
        parts: dict[str, Any] = {part.name: getattr(self, part.name) for part in fields(self)}
        some: dict[str, Any] = {
            name: None if part is None else part[::step] for name, part in parts.items()
        }
        return BodyCloud(**some)


@dataclass(frozen=True, eq=False)
class BreathAt:
    """How far vertices are from where they would be at mean breath.

    mm: (V,) float32, how far inside that place, along the normal.
    sigma_mm: (V,) float32, of that.
    """

    mm: Floats
    sigma_mm: Floats


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """A closed triangle mesh with outward faces.

    vertices: (V, 3) float64, mm.
    faces: (F, 3) int64.
    normals: (V, 3) float32, unit, outward.
    colours: (V, 3) uint8.
    sigma_mm: (V,) float32, NaN on filled vertices.
    filled: (F,) bool, faces that no pair measured and that were filled to close the mesh.
    breath: how to bring the mesh to mean breath, for a person who was followed.
    regions: (V,) uint8, as those of a cloud; unsure on filled vertices.
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
        return np.where(self.filled, np.uint8(UNSURE), of_faces(self.regions, self.faces))

    @cached_property
    def filled_share(self) -> float:
        """Share of the surface's area that was filled."""
        area = face_areas(self.vertices, self.faces)
        return float(area[self.filled].sum() / area.sum()) if area.any() else 0.0

    def at_mean_breath(self, sigmas: float = 0.0) -> BodyMesh:
        """The body at mean breath; sigmas: everywhere this many standard deviations fuller."""
        if self.breath is None:
            return self
        way = (self.breath.mm + sigmas * self.breath.sigma_mm).astype(np.float64)
        return replace(self, vertices=self.vertices + way[:, None] * self.normals, breath=None)

    def measured_part(self) -> BodyMesh:
        """The open surface that is left without the filled faces."""
        vertices, faces, used = drop_unused_vertices(self.vertices, self.faces[~self.filled])
        return self.part(vertices, faces, used, np.zeros(len(faces), bool))

    def part(self, vertices: Array, faces: Indices, used: Indices, filled: Mask) -> BodyMesh:
        """The mesh with only the vertices `used` (U,), and faces (F, 3) of these."""
        return BodyMesh(
            vertices,
            faces,
            self.normals[used],
            self.colours[used],
            self.sigma_mm[used],
            filled,
            regions=regions_at(self.regions, used),
        )
