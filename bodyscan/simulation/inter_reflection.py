"""Light between surfaces: one diffuse bounce of the projector's light.

Samples spread evenly over the surfaces are grouped into facets. A facet of area A re-emits the
projector's light with radiosity B (albedo times irradiance), and a place at distance r receives

    E' = sum over facets of B V cos cos' A / (pi r^2 + A),

the form factor of a disc of that area, exact on its axis. V says whether the place sees the facet;
it is computed once per pair of facets, since a place sees nearly what the facet around it sees.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.simulation.lamps import Lamps, laser_light
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene, dot

_SAMPLES = 32
"""Samples per facet: a stripe is much narrower than a facet, whose mean light is wanted."""

_ROOM_FACETS = 100
"""Most facets of a surface that encloses everything else: far away, large facets suffice."""

_SPREAD = (0.7548776662466927, 0.5698402909980532)
"""Steps of the additive sequence that fills a square most evenly (Roberts, 2018)."""

_AT_ONCE = 2_000_000


@dataclass(frozen=True, eq=False)
class LitFacets:
    """Facets that the projector lights, L of all K; camera frame.

    samples: the N places on surfaces that were sampled.
    facet: (N,) number, among all facets, of the one to which each belongs.
    weight, s: (N,) grey level that a lit stripe would cause there, and the stripe coordinate.
    lit: (L,) numbers of the lit facets.
    middles: (L, 3) mm.
    normals: (L, 3) unit, on the side of the light.
    area: (L,) mm^2.
    seen: (K, L), whether two facets see each other.
    """

    samples: Hits
    facet: Indices
    weight: Floats
    s: Floats
    lit: Indices
    middles: Floats
    normals: Floats
    area: Floats
    seen: Mask

    def radiosity(self, light: Floats) -> Floats:
        """Radiosity (L,) in grey levels if light (N,), 0 to 1, falls on the samples."""
        total = np.bincount(self.facet, self.weight * light) / np.bincount(self.facet)
        return total[self.lit].astype(np.float32)

    def irradiance(self, hits: Hits, radiosity: Floats) -> Floats:
        """Grey levels (F, N) that hits (N) would have if they were white, due to radiosities (F, L)
        alone, on the side that the camera sees."""
        result = np.zeros((len(radiosity), len(hits.depth)), np.float32)
        known = np.flatnonzero(np.isfinite(hits.depth))
        if not self.lit.size or not known.size:
            return result
        _, sample = cKDTree(self.samples.points).query(hits.points[known])
        around = self.facet[sample]
        step = max(1, _AT_ONCE // len(self.lit))
        for start in range(0, len(known), step):
            cut = slice(start, start + step)
            factors = self._factors(hits, known[cut]) * self.seen[around[cut]]
            result[:, known[cut]] = radiosity @ factors.T
        return result

    def _factors(self, hits: Hits, places: Indices) -> Floats:
        """Form factors (P, L) from places (P,) to the facets that they see."""
        points, normals = hits.points[places], hits.normals[places]
        towards = np.where(dot(points, normals) < 0.0, np.float32(1.0), np.float32(-1.0))
        normals = np.multiply(normals, (towards / np.sqrt(dot(normals, normals)))[:, None])
        cross = points @ self.middles.T
        square = dot(points, points)[:, None] - 2.0 * cross + dot(self.middles, self.middles)
        square = np.maximum(square, np.float32(1e-3))
        here = normals @ self.middles.T - dot(normals, points)[:, None]
        there = points @ self.normals.T - dot(self.middles, self.normals)
        cosines = np.maximum(here, 0.0) * np.maximum(there, 0.0) / square
        return cosines * self.area / (np.float32(np.pi) * square + self.area)


def light_facets(scene: Scene, projector: Projector, lamps: Lamps, facet_mm: float) -> LitFacets:
    """Facets of about facet_mm x facet_mm: the samples of a surface in one cell of a grid that face
    the light alike."""
    samples, share = _samples(scene, facet_mm)
    light = laser_light(scene, samples, projector, lamps, seen=False)
    weight, s = light.weight, light.s
    towards = projector.source(np.nan_to_num(s)) - samples.points
    side = np.where(dot(towards, samples.normals) < 0.0, np.float32(-1.0), np.float32(1.0))
    normals = samples.normals * (side / np.sqrt(dot(samples.normals, samples.normals)))[:, None]
    size = np.maximum(facet_mm, np.sqrt(share * _SAMPLES))
    cell = np.floor(samples.points / size[:, None]).astype(np.int64)
    keys = np.column_stack([samples.surface, cell, normals > 0.0])
    facet = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    middles = samples.points[_nearest_to_mean(facet, samples.points)]
    summed = _sums(facet, normals)
    lit = np.flatnonzero(np.bincount(facet, weight) > 0.0)
    return LitFacets(
        samples,
        facet,
        weight,
        s,
        lit,
        middles[lit],
        (summed / np.linalg.norm(summed, axis=1)[:, None])[lit].astype(np.float32),
        np.bincount(facet, share)[lit].astype(np.float32),
        _seen(scene, middles, lit),
    )


def _samples(scene: Scene, facet_mm: float) -> tuple[Hits, Array]:
    """Places spread evenly over all surfaces, and the area (mm^2) that each represents."""
    parts, shares = [], []
    for number, surface in enumerate(scene.surfaces):
        a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        total = float(areas.sum())
        facets = max(total / facet_mm**2, 1.0)
        facets = min(facets, _ROOM_FACETS) if surface.encloses else facets
        count = int(np.ceil(facets * _SAMPLES))
        ladder = np.cumsum(areas) / total
        place = (np.arange(count) + 0.5) / count
        triangles = np.minimum(np.searchsorted(ladder, place), len(areas) - 1)
        uv = (np.arange(1, count + 1)[:, None] * _SPREAD) % 1.0
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1.0, 1.0 - uv, uv)
        parts.append(scene.places(number, triangles, uv.astype(np.float32)))
        shares.append(np.full(count, total / count))
    joined = (np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Hits))
    return Hits(*joined), np.concatenate(shares)


def _sums(group: Indices, values: NDArray[np.floating]) -> Array:
    """Sums (K, 3) of values (N, 3) in K groups."""
    return np.stack([np.bincount(group, column) for column in values.T], axis=1)


def _nearest_to_mean(group: Indices, points: Floats) -> Indices:
    """Numbers (K,) of the points (N, 3) nearest to each group's mean: unlike it, they lie on a
    surface."""
    count = np.bincount(group)
    off = points - (_sums(group, points) / count[:, None])[group]
    order = np.lexsort((np.sum(off**2, axis=1), group))
    return order[np.cumsum(count) - count]


def _seen(scene: Scene, middles: Floats, lit: Indices) -> Mask:
    """Whether the middles (K, 3) see those that are lit, (K, L)."""
    rows = [scene.joined(middles, np.broadcast_to(middles[i], middles.shape)) for i in lit]
    return np.stack(rows, axis=1) if rows else np.zeros((len(middles), 0), bool)
