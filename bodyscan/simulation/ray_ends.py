"""Where a band's rays end, and what light does there.

Most pixels see one smooth piece of one surface. There only the rays between pixels are cast, and
what lies inside the pixel is interpolated: a tenth of the rays. Where corners differ, all are cast.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from bodyscan.arrays import Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.simulation.lamps import Lamps, laser_light, room_light
from bodyscan.simulation.lens import sample_offsets
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene
from bodyscan.simulation.view import Band

FLAT_MM = 0.04
"""How far a corner may be off the facet at the opposite one. Between them the surface is then
within a quarter of it, a tenth of a scan's error."""


@dataclass(frozen=True, eq=False)
class RayEnds:
    """What the rays (R, C, K) of a band meet.

    white, gloss: grey level of the projector's full light, as scattered by a white surface, and as
        mirrored by skin.
    s: stripe coordinate, NaN where none of that light arrives.
    room: grey level of the room's light on a white surface.
    albedo, skin: as in `Hits`.
    depth: mm.
    surface: its number.
    across, down: place on a print.
    """

    white: Floats
    gloss: Floats
    s: Floats
    room: Floats
    albedo: Floats
    skin: Floats
    depth: Floats
    surface: Floats
    across: Floats
    down: Floats


def ends_of_rays(scene: Scene, band: Band, projector: Projector, lamps: Lamps) -> RayEnds:
    """Cast the band's rays, or interpolate them, and light their ends."""
    rows, columns, samples, _ = band.rays.shape
    hits = scene.cast(band.corners.reshape(-1, 3))
    corners = _lit(scene, hits, projector, lamps).reshape(-1, rows + 1, columns + 1)
    even = _even(hits, RayEnds(*corners))
    values = np.empty((len(fields(RayEnds)), rows, columns, samples), np.float32)
    offsets = sample_offsets(round(samples**0.5)).astype(np.float32)
    interpolate(corners, band.shift, offsets, even, values)
    cast = scene.cast(band.rays[~even].reshape(-1, 3))
    values[:, ~even] = _lit(scene, cast, projector, lamps).reshape(len(values), -1, samples)
    ends = RayEnds(*values)
    scene.print_on(ends.surface, ends.across, ends.down, ends.albedo)
    return ends


def _lit(scene: Scene, hits: Hits, projector: Projector, lamps: Lamps) -> Floats:
    """Fields (F, N) in the order of `RayEnds`."""
    white = replace(hits, albedo=np.ones_like(hits.albedo))
    light = laser_light(scene, white, projector, lamps)
    gloss = np.zeros_like(light.weight) if light.gloss is None else light.gloss
    return np.stack(
        [
            light.weight,
            gloss,
            light.s,
            room_light(hits, lamps),
            hits.albedo,
            hits.skin,
            hits.depth,
            hits.surface.astype(np.float32),
            *hits.places.T,
        ]
    )


def _even(hits: Hits, corners: RayEnds) -> Mask:
    """Pixels (R, C) whose corners lie on one smooth piece of a surface, all lit or none."""
    shape = corners.depth.shape
    points, facets = hits.points.reshape(*shape, 3), hits.facets.reshape(*shape, 3)
    facets = facets / np.maximum(np.linalg.norm(facets, axis=-1, keepdims=True), 1e-12)
    kind = 4 * corners.surface + 2 * (corners.white > 0) + (corners.skin > 0.5)
    kind[~np.isfinite(corners.depth)] = np.nan  # equal to nothing
    first, second, third, fourth = (
        (slice(r, shape[0] - 1 + r), slice(c, shape[1] - 1 + c))
        for r, c in ((0, 0), (1, 1), (0, 1), (1, 0))
    )
    even = (
        (kind[first] == kind[second]) & (kind[first] == kind[third]) & (kind[first] == kind[fourth])
    )
    for one, other in ((first, second), (third, fourth)):
        way = points[other] - points[one]
        for facet in (facets[one], facets[other]):
            even &= np.abs(np.einsum("rck,rck->rc", way, facet)) < FLAT_MM
    return np.asarray(even)


@compiled
def interpolate(
    corners: Floats, shift: Floats, offsets: Floats, even: Mask, values: Floats
) -> None:
    """Fill `values` (F, R, C, K) of even pixels (R, C) from their corners (F, R + 1, C + 1),
    bilinearly at offsets (K, 2) + shift (R, C, 2), modulo 1."""
    count, rows, columns, samples = values.shape
    x, y = np.empty(samples, np.float32), np.empty(samples, np.float32)
    for r in range(rows):
        for c in range(columns):
            if not even[r, c]:
                continue
            for k in range(samples):
                x[k] = (offsets[k, 0] + shift[r, c, 0]) % np.float32(1.0)
                y[k] = (offsets[k, 1] + shift[r, c, 1]) % np.float32(1.0)
            for f in range(count):
                start = corners[f, r, c]
                right, below = corners[f, r, c + 1] - start, corners[f, r + 1, c] - start
                bent = corners[f, r + 1, c + 1] - start - right - below
                for k in range(samples):
                    values[f, r, c, k] = start + x[k] * right + y[k] * (below + x[k] * bent)


@compiled
def mean_light(
    weight: Floats, index: np.ndarray[tuple[int, ...], np.dtype[np.int32]], table: Floats
) -> Floats:
    """Mean (R, C) over samples of weight (R, C, K) times the
    light at entries (R, C, K) of a table."""
    rows, columns, samples = weight.shape
    mean = np.empty((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            total = np.float32(0.0)
            for k in range(samples):
                total += weight[r, c, k] * table[index[r, c, k]]
            mean[r, c] = total / np.float32(samples)
    return mean


@compiled
def least(samples: Floats) -> Floats:
    """The least (R, C) of samples (R, C, K)."""
    rows, columns, count = samples.shape
    result = np.empty((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            value = samples[r, c, 0]
            for k in range(1, count):
                value = min(value, samples[r, c, k])
            result[r, c] = value
    return result
