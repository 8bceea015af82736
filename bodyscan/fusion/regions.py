"""Label the points of a cloud as skin, hair or dark cloth by darkness, roughness and position.

One person's skin varies in brightness by a factor of two, moles, lips and remaining shading
included. Black cloth and dark hair are darker than a third of that; anything in between is unsure.
Hair and cloth differ in position first: hair grows on the head and hangs from there. And strands
and locks make hair rougher than cloth, where noise lets that be measured at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from bodyscan.arrays import Array, Bytes, Crop, Floats, Indices, Mask, find_crop
from bodyscan.fusion.brightness import MIN_GREY
from bodyscan.fusion.quadratic_fit import fit_full_windows, make_window_basis
from bodyscan.fusion.smoothing import (
    compute_inverse_depths,
    compute_window_reach,
    estimate_pixel_size,
)
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN, group_medians
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import DARK_CLOTH, HAIR, SKIN, UNSURE, BodyCloud
from bodyscan.motion.body_parts import NECK
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage

DARK, DIM = 1 / 3, 1 / 2
"""Relative to the subject's median brightness. Moles have 0.45 of the skin around; black hair and
cloth reflect 3 to 6 % of the light, skin 10 (very dark) to 65 %."""
CELL_MM = 30.0
"""Smaller than the distance of hair and a collar; some hundred pixels."""
ROUGH_MM = 0.2
"""Half of what locks of hair are apart in depth, as far as a window of 7 mm preserves it."""


@dataclass(frozen=True, eq=False)
class Regions:
    """Of N points: each one's region in `REGION_NAMES`, uint8; relief_mm, float32: standard
    deviation of hair about the smoothed surface, 0 elsewhere."""

    numbers: Bytes
    relief_mm: Floats


@dataclass(frozen=True, eq=False)
class _Grid:
    """A grid of cubes around the body: its lowest corner, mm, and its size along each axis."""

    origin: Array
    shape: tuple[int, ...]

    @staticmethod
    def from_points(points: Array) -> _Grid:
        low, high = points.min(axis=0), points.max(axis=0)
        # One more layer on all sides, so that every cell has neighbours.
        shape = np.floor((high - low) / CELL_MM).astype(int) + 3
        return _Grid(low - CELL_MM, tuple(shape.tolist()))

    @property
    def count(self) -> int:
        return int(np.prod(self.shape))

    @property
    def centres(self) -> Array:
        """Centres of the cells, (count, 3) mm."""
        index = np.stack(np.unravel_index(np.arange(self.count), self.shape), axis=-1)
        return self.origin + CELL_MM * (index + 0.5)

    def find(self, points: Array) -> Indices:
        """Number (N,) of the cell of each point (N, 3), or of the nearest cell."""
        index = np.floor((points - self.origin) / CELL_MM).astype(np.int64)
        return np.ravel_multi_index(tuple(index.T), self.shape, mode="clip")

    def label_patches(self, occupied: Mask) -> Indices:
        """Number (count,) of the connected patch of each cell, 0 if it is not occupied."""
        label = ndimage.label(occupied.reshape(self.shape), np.ones((3, 3, 3)))[0]
        return np.asarray(label.ravel(), np.int64)

    def compute_medians(self, values: Floats, cell: Indices) -> Array:
        """Median (count,) of the values (N,) in each cell, by the cell (N,) of each; 0 if none."""
        return group_medians(values, cell, self.count)

    def find_majority(self, mask: Mask, among: Mask) -> Mask:
        """(count,): cells around which more than half of the `among` cells are in `mask`."""
        counts = [
            ndimage.uniform_filter(some.reshape(self.shape).astype(float), 3).ravel()
            for some in (mask & among, among)
        ]
        return np.asarray(counts[0] > 0.5 * counts[1] + 1e-9)


@dataclass(frozen=True, eq=False)
class _Textures:
    """The texture of each cell, (count,): whether it is known, of 50 pixels or more, and whether it
    is rough beyond noise, or smooth with it; relief_mm: standard deviation without noise's share."""

    known: Mask
    rough: Mask
    smooth: Mask
    relief_mm: Array


def label_regions(
    cloud: BodyCloud,
    range_images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    window_mm: float,
) -> Regions:
    """Label each point of a cloud merged from range images that were smoothed over `window_mm`.

    All points are unsure if the images are too dark, or if more than a tenth is so bright that the
    rest would be dark beside it: it is then open which part is skin.
    """
    grey = cloud.grey.astype(np.float32)
    typical = float(np.median(grey))
    if DARK * typical < MIN_GREY or np.mean(grey > typical / DARK) > 0.1:
        unsure = np.full(len(grey), UNSURE, np.uint8)
        return Regions(unsure, np.zeros(len(grey), np.float32))
    cells = _Grid.from_points(cloud.points)
    cell, dark = cells.find(cloud.points), grey < DARK * typical
    # Dim points among dark ones are dark, and bright ones highlights.
    total, darks = (np.bincount(some, minlength=cells.count) for some in (cell, cell[dark]))
    covered = darks > 0.5 * total
    patch = cells.label_patches(darks > 0)
    head = find_head(cloud.points, cells.centres)
    wanted = head | (patch > 0)
    texture = _classify_textures(cells, wanted, range_images, rig_from_camera, window_mm)
    known = texture.known & covered
    rough = cells.find_majority(texture.rough, known)
    smooth = cells.find_majority(texture.smooth, known)

    # 5 cm2 of a person are too little to affect any girth.
    large = np.bincount(patch, darks) >= 3e-4 * len(grey)
    on_head = np.isin(patch, patch[head & covered])
    kind = np.where(large[patch], _label_coverings(head, on_head, rough, smooth), UNSURE)
    # Fair hair is as bright as skin.
    bare = head & (darks == 0)
    shaggy = bare & cells.find_majority(texture.rough, texture.known & bare)
    bright = np.where(covered | shaggy, UNSURE, SKIN)
    dim = np.where(covered, kind, UNSURE)
    found = np.where(dark, kind[cell], np.where(grey < DIM * typical, dim[cell], bright[cell]))
    relief_mm = np.where(found == HAIR, texture.relief_mm[cell], 0.0)
    return Regions(found.astype(np.uint8), relief_mm.astype(np.float32))


def _label_coverings(head: Mask, on_head: Mask, rough: Mask, smooth: Mask) -> Indices:
    """Label dark cells (count,): on the head, in one patch with it, and elsewhere."""
    hanging = np.where(rough, HAIR, np.where(smooth, DARK_CLOTH, UNSURE))
    elsewhere = np.where(rough, UNSURE, DARK_CLOTH)
    worn = np.where(smooth, DARK_CLOTH, HAIR)
    return np.where(head, worn, np.where(on_head, hanging, elsewhere))


def find_head(points: Array, queries: Array) -> Mask:
    """Find which queries (M, 3) lie on the head of a standing body with points (N, 3), (M,).

    Within 0.12 of the stature around the upper body's axis: heads lean forward, and hair is long.
    """
    top = points[:, 2].max()
    above = points[points[:, 2] > 0.5 * top, :2]
    across = np.linalg.norm(queries[:, :2] - np.median(above, axis=0), axis=1)
    return np.asarray((queries[:, 2] > NECK * top) & (across < 0.12 * top))


def _classify_textures(
    cells: _Grid,
    wanted: Mask,
    range_images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    window_mm: float,
) -> _Textures:
    """Classify the `wanted` cells (count,) by the median residuals of their pixels."""
    nothing = Roughness(np.zeros((0, 3)), *np.zeros((2, 0), np.float32))

    def measure(image: RangeImage) -> Roughness:
        pose, inside = rig_from_camera[image.pair], image.valid
        inside[inside] = wanted[cells.find(pose.apply(image.points[inside].astype(np.float64)))]
        box = find_crop(inside)
        return nothing if box is None else measure_roughness(image, pose, box, window_mm)

    found = [nothing, *map_threads(measure, range_images)]
    cell = np.concatenate([cells.find(one.points) for one in found])
    residual_mm = np.concatenate([one.residual_mm for one in found])
    expected_mm = np.concatenate([one.expected_mm for one in found])
    known = np.bincount(cell, minlength=cells.count) >= 50
    scatter_mm = SIGMAS_PER_MEDIAN * cells.compute_medians(residual_mm, cell)
    sigmas = SIGMAS_PER_MEDIAN * cells.compute_medians(residual_mm / expected_mm, cell)
    noise_mm = cells.compute_medians(expected_mm, cell)
    relief_mm = np.sqrt(np.maximum(scatter_mm**2 - noise_mm**2, 0.0))
    # Sigmas of dark cloth are right to a third; where several exposures show relief they include
    # it, so that only what is coarser than the stripes counts.
    rough = known & (sigmas > 3.0) & (scatter_mm > ROUGH_MM)
    return _Textures(known, rough, known & (scatter_mm < ROUGH_MM), relief_mm)


@dataclass(frozen=True, eq=False)
class Roughness:
    """Pixels with a full window around them: points (N, 3) mm, rig frame; distance along the ray
    from the quadratic through the window, and its standard deviation by noise alone, (N,)."""

    points: Array
    residual_mm: Floats
    expected_mm: Floats


def measure_roughness(
    image: RangeImage, rig_from_camera: RigidTransform, box: Crop, window_mm: float
) -> Roughness:
    """Compare the pixels in a box with quadratics in windows of about `window_mm`."""
    image = image.crop(box)
    inverse, noise = compute_inverse_depths(image)
    reach = compute_window_reach(estimate_pixel_size(inverse, image.camera), window_mm)
    fit, full = fit_full_windows(inverse, noise, reach)
    residual = (inverse - fit.value)[full]
    points = image.points[full]
    # Along the ray a point moves by its length over z times dz, and dz is z squared times d(1/z).
    length = np.linalg.norm(points, axis=1) * points[:, 2]
    basis = make_window_basis(reach)
    absorbed = np.linalg.inv(basis.T @ basis)[0, 0]  # share of a pixel's variance in its fit
    left = np.float32(np.sqrt(1.0 - absorbed))
    points_rig = rig_from_camera.apply(points.astype(np.float64))
    return Roughness(points_rig, np.abs(residual) * length, left * noise[full] * length)
