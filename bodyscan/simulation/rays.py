"""A camera's rays, and the light where they end.

Most pixels see one smooth piece of one surface. There only the rays through the pixels' corners are
cast and the interior is interpolated: a tenth of the rays. Where corners differ, all are cast.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.simulation.lamps import Lamps, compute_laser_light, compute_room_light
from bodyscan.simulation.lens import TrueCamera, sample_directions, sample_offsets
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene
from bodyscan.simulation.settings import Optics


@dataclass(frozen=True, eq=False)
class Band:
    """Part of an image, R rows and C columns, and its rays, z = 1."""

    rows: slice
    columns: slice
    rays: Floats  # (R, C, K, 3) through points inside pixels
    shift: Floats  # (R, C, 2) by which these points are shifted from `lens.sample_offsets`
    corners: Floats  # (R + 1, C + 1, 3) through the pixels' corners

    @staticmethod
    def from_rows(camera: TrueCamera, samples: int, rng: np.random.Generator, rows: slice) -> Band:
        shift = rng.random((rows.stop - rows.start, camera.width, 2))
        rays = sample_directions(camera, samples, shift, rows)
        v, u = np.mgrid[rows.start : rows.stop + 1, 0 : camera.width + 1] - 0.5
        corners: Array = camera.directions(np.stack([u, v], axis=-1).reshape(-1, 2))
        return Band(
            rows,
            slice(0, camera.width),
            rays.reshape(*shift.shape[:2], -1, 3),
            shift.astype(np.float32),
            corners.reshape(*u.shape, 3).astype(np.float32),
        )

    def crop_columns(self, first: int, last: int) -> Band:
        """Crop to the columns from first to last, both included."""
        cut = slice(first, last + 1)
        return replace(
            self,
            columns=cut,
            rays=self.rays[:, cut],
            shift=self.shift[:, cut],
            corners=self.corners[:, first : last + 2],
        )

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its pixels in an image."""
        return self.rows, self.columns


@dataclass(frozen=True, eq=False)
class View:
    """A camera's rays, kept for all its shots; the bands cover its image."""

    camera: TrueCamera
    optics: Optics
    bands: tuple[Band, ...]

    @staticmethod
    def from_camera(camera: TrueCamera, optics: Optics, rng: np.random.Generator) -> View:
        """Draw the rays of each pixel; bands of 250,000 rays bound the memory."""
        rows = max(1, 250_000 // (camera.width * optics.samples**2))
        cuts = [slice(r, min(r + rows, camera.height)) for r in range(0, camera.height, rows)]
        bands = (Band.from_rows(camera, optics.samples, rng, cut) for cut in cuts)
        return View(camera, optics, tuple(bands))

    def bands_around(self, chosen: Mask) -> Iterator[Band]:
        """Yield the bands that contain chosen pixels (H, W), cropped to those columns."""
        for band in self.bands:
            columns = np.flatnonzero(chosen[band.rows].any(axis=0))
            if columns.size:
                yield band.crop_columns(int(columns[0]), int(columns[-1]))


@dataclass(frozen=True, eq=False)
class RayEnds:
    """What the rays (R, C, K) of a band meet."""

    # white, gloss: grey level of the projector's full light, as scattered by a white surface, and
    # as mirrored by skin.
    white: Floats
    gloss: Floats
    s: Floats  # stripe coordinate, NaN where none of that light arrives
    room: Floats  # grey level of the room's light on a white surface
    # albedo, skin: as in `Hits`.
    albedo: Floats
    skin: Floats
    depth: Floats  # mm
    surface: Floats  # its number
    # across, down: position on a print, as `Hits.print_xy`.
    across: Floats
    down: Floats


def trace_band(scene: Scene, band: Band, projector: Projector, lamps: Lamps) -> RayEnds:
    """Cast the band's rays, or interpolate them, and light their ends."""
    rows, columns, samples, _ = band.rays.shape
    hits = scene.cast(band.corners.reshape(-1, 3))
    corners = _compute_light_fields(scene, hits, projector, lamps).reshape(
        -1, rows + 1, columns + 1
    )
    even = _mask_smooth(hits, RayEnds(*corners))
    values = np.empty((len(fields(RayEnds)), rows, columns, samples), np.float32)
    offsets = sample_offsets(round(samples**0.5)).astype(np.float32)
    interpolate(corners, band.shift, offsets, even, values)
    cast = scene.cast(band.rays[~even].reshape(-1, 3))
    values[:, ~even] = _compute_light_fields(scene, cast, projector, lamps).reshape(
        len(values), -1, samples
    )
    ends = RayEnds(*values)
    scene.print_on(ends.surface, ends.across, ends.down, ends.albedo)
    return ends


def _compute_light_fields(scene: Scene, hits: Hits, projector: Projector, lamps: Lamps) -> Floats:
    """Compute fields (F, N) in the order of `RayEnds`."""
    white = replace(hits, albedo=np.ones_like(hits.albedo))
    light = compute_laser_light(scene, white, projector, lamps)
    return np.stack(
        [
            light.weight,
            light.gloss,
            light.s,
            compute_room_light(hits, lamps),
            hits.albedo,
            hits.skin,
            hits.depth,
            hits.surface.astype(np.float32),
            *hits.print_xy.T,
        ]
    )


def _mask_smooth(hits: Hits, corners: RayEnds) -> Mask:
    """Mask pixels (R, C) whose corners lie on one smooth piece of a surface, all lit or none."""
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
        edge = points[other] - points[one]
        for facet in (facets[one], facets[other]):
            # A corner this near the facet of the opposite one: the surface between is within 0.01 mm.
            even &= np.abs(np.einsum("rck,rck->rc", edge, facet)) < 0.04
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
                twist = corners[f, r + 1, c + 1] - start - right - below
                for k in range(samples):
                    values[f, r, c, k] = start + x[k] * right + y[k] * (below + x[k] * twist)


@compiled
def average_light(
    weight: Floats, index: np.ndarray[tuple[int, ...], np.dtype[np.int32]], table: Floats
) -> Floats:
    """(R, C): mean over a pixel's K samples of weight x table[index], both (R, C, K); divides by K, not
    by the sum of weights."""
    rows, columns, samples = weight.shape
    mean = np.empty((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            total = np.float32(0.0)
            for k in range(samples):
                total += weight[r, c, k] * table[index[r, c, k]]
            mean[r, c] = total / np.float32(samples)
    return mean
