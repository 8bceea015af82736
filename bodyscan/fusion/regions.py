"""Label the points of a cloud as skin, hair or dark cloth by darkness, roughness and place.

One person's skin varies in brightness by a factor of two, moles, lips and remaining shading
included. Black cloth and dark hair are darker than a third of that; anything in between is
undecided. Hair and cloth differ in place first: hair grows on the head and hangs from there. And
hair is rough because its strands and locks stand apart, where noise lets that be seen at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from bodyscan.alignment.part_names import NECK
from bodyscan.arrays import Array, Bytes, Floats, Indices, Mask, find_crop
from bodyscan.compiled import compiled
from bodyscan.fusion.brightness import DARKEST
from bodyscan.fusion.roughness import Misfits, misfits
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import DARK_CLOTH, HAIR, SKIN, UNSURE, BodyCloud
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage

DARK, DIM = 1 / 3, 1 / 2
"""Relative to the subject's usual brightness. Moles have 0.45 of the skin around; black hair and
cloth reflect 3 to 6 % of the light, skin 10 (very dark) to 65 %."""
SOME_BRIGHTER = 0.1
"""Share of points so bright that the usual ones would be dark beside them: it is then not known
which of the two is skin, under black clothes or white ones."""
CELL_MM = 30.0
"""Smaller than the distance of hair and a collar; some hundred pixels."""
SMALLEST = 3e-4
"""Share of the points: 5 cm2 of a person, too little to affect any girth."""
MOST = 0.5
"""Share of a cell's points: dim points among dark ones are dark, and bright ones highlights."""
ROUGH, ROUGH_MM = 3.0, 0.2
"""ROUGH: times what sigmas predict. Those of dark cloth are right to a third; where several exposures
show relief they carry it, so that only what is coarser than the stripes counts.
ROUGH_MM: half of what locks of hair stand apart, as far as a window of 7 mm preserves it."""
FEWEST = 50  # pixels needed to tell how rough a cell is
HEAD_WIDE = 0.12  # of the stature: around the axis, for heads that lean forward and long hair


@dataclass(frozen=True, eq=False)
class Regions:
    """Of N points.

    numbers: (N,) uint8, each point's region in `REGION_NAMES`.
    relief_mm: (N,) float32, how far strands and locks of hair stand off a smooth surface, standard
        deviation; 0 elsewhere. Smoothing flattens it.
    """

    numbers: Bytes
    relief_mm: Floats


@dataclass(frozen=True, eq=False)
class _Cells:
    """A grid of cubes around the body: its lowest corner, mm, and its size along each axis."""

    origin: Array
    shape: tuple[int, ...]

    @staticmethod
    def around(points: Array) -> _Cells:
        low, high = points.min(axis=0), points.max(axis=0)
        # One more layer on all sides, so that every cell has neighbours.
        shape = np.floor((high - low) / CELL_MM).astype(int) + 3
        return _Cells(low - CELL_MM, tuple(shape.tolist()))

    @property
    def count(self) -> int:
        return int(np.prod(self.shape))

    @property
    def centres(self) -> Array:
        """Centres of the cells, (count, 3) mm."""
        place = np.stack(np.unravel_index(np.arange(self.count), self.shape), axis=-1)
        return self.origin + CELL_MM * (place + 0.5)

    def find(self, points: Array) -> Indices:
        """Number (N,) of the cell of each point (N, 3); the nearest cell for points outside."""
        place = np.floor((points - self.origin) / CELL_MM).astype(np.int64)
        return np.ravel_multi_index(tuple(place.T), self.shape, mode="clip")

    def patches(self, taken: Mask) -> Indices:
        """Number (count,) of the patch of neighbours that each cell belongs to, 0 if not taken."""
        label = ndimage.label(taken.reshape(self.shape), np.ones((3, 3, 3)))[0]
        return np.asarray(label.ravel(), np.int64)

    def mostly(self, said: Mask, among: Mask) -> Mask:
        """(count,): cells around which most of the `among` cells are `said` too."""
        counts = [
            ndimage.uniform_filter(some.reshape(self.shape).astype(float), 3).ravel()
            for some in (said & among, among)
        ]
        return np.asarray(counts[0] > MOST * counts[1] + 1e-9)


@dataclass(frozen=True, eq=False)
class _Texture:
    """Texture of each cell, (count,).

    known: whether enough pixels were examined.
    rough: whether it is rough beyond noise.
    smooth: whether it is smooth, noise included.
    relief_mm: standard deviation of what lies off the smooth surface beyond noise.
    """

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
    """Label each point of a cloud.

    range_images: those that the cloud was merged from.
    window_mm: window over which they were smoothed.

    All points are unsure if the images are too dark, or if so much is so bright that it is open
    which part is skin.
    """
    grey = cloud.colours[:, 0].astype(np.float32)
    usual = float(np.median(grey))
    if DARK * usual < DARKEST or np.mean(grey > usual / DARK) > SOME_BRIGHTER:
        unsure = np.full(len(grey), UNSURE, np.uint8)
        return Regions(unsure, np.zeros(len(grey), np.float32))
    cells = _Cells.around(cloud.points)
    cell, dark = cells.find(cloud.points), grey < DARK * usual
    own, darks = (np.bincount(some, minlength=cells.count) for some in (cell, cell[dark]))
    covered = darks > MOST * own
    patch = cells.patches(darks > 0)
    head = _head(cloud.points, cells.centres)
    texture = _texture(cells, patch > 0, head, range_images, rig_from_camera, window_mm)
    told = texture.known & covered
    rough, smooth = cells.mostly(texture.rough, told), cells.mostly(texture.smooth, told)

    large = np.bincount(patch, darks) >= SMALLEST * len(grey)
    on_head = np.isin(patch, patch[head & covered])
    kind = np.where(large[patch], _coverings(head, on_head, rough, smooth), UNSURE)
    # Fair hair is as bright as skin.
    bare = head & (darks == 0)
    shaggy = bare & cells.mostly(texture.rough, texture.known & bare)
    bright = np.where(covered | shaggy, UNSURE, SKIN)
    dim = np.where(covered, kind, UNSURE)
    found = np.where(dark, kind[cell], np.where(grey < DIM * usual, dim[cell], bright[cell]))
    relief_mm = np.where(found == HAIR, texture.relief_mm[cell], 0.0)
    return Regions(found.astype(np.uint8), relief_mm.astype(np.float32))


def _coverings(head: Mask, on_head: Mask, rough: Mask, smooth: Mask) -> Indices:
    """What dark cells (count,) are: on the head, in one patch with it, and elsewhere."""
    hanging = np.where(rough, HAIR, np.where(smooth, DARK_CLOTH, UNSURE))
    elsewhere = np.where(rough, UNSURE, DARK_CLOTH)
    worn = np.where(smooth, DARK_CLOTH, HAIR)
    return np.where(head, worn, np.where(on_head, hanging, elsewhere))


def _head(points: Array, places: Array) -> Mask:
    """Which places (M, 3) lie on the head of a standing body, (M,)."""
    top = points[:, 2].max()
    above = points[points[:, 2] > 0.5 * top, :2]
    across = np.linalg.norm(places[:, :2] - np.median(above, axis=0), axis=1)
    return np.asarray((places[:, 2] > NECK * top) & (across < HEAD_WIDE * top))


def _texture(
    cells: _Cells,
    dark: Mask,
    head: Mask,
    range_images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    window_mm: float,
) -> _Texture:
    """Texture of dark cells and of the head; elsewhere it is not known."""
    asked = dark | head

    def looked_at(image: RangeImage) -> Misfits | None:
        at, wanted = rig_from_camera[image.pair], np.zeros(image.sigma_mm.shape, np.bool_)
        matrix, grid = at.matrix[:3], asked.reshape(cells.shape)
        lies_in(image.points, image.sigma_mm, matrix, cells.origin, grid, wanted)
        box = find_crop(wanted)
        return None if box is None else misfits(image, at, box, window_mm)

    each = map_threads(looked_at, range_images, stage="naming regions")
    found = [one for one in each if one is not None]
    if not found:
        nowhere = np.zeros(cells.count, bool)
        return _Texture(nowhere, nowhere, nowhere, np.zeros(cells.count))
    return _told(cells, found)


@compiled
def lies_in(
    points: Floats,
    sigma_mm: Floats,
    rig_from_camera: Array,
    origin: Array,
    asked: Mask,
    wanted: Mask,
) -> None:
    """Set wanted (H, W): which points (H, W, 3) with a sigma lie in the cells that are asked for.

    rig_from_camera: (3, 4).
    origin: lowest corner of the cells (a, b, c), (3,) mm; points outside count for the nearest
        cell.
    """
    m, low = rig_from_camera, origin
    for v in range(wanted.shape[0]):
        for u in range(wanted.shape[1]):
            if not np.isfinite(sigma_mm[v, u]):
                continue
            x, y, z = points[v, u, 0], points[v, u, 1], points[v, u, 2]
            a = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] - low[0]) / CELL_MM
            b = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] - low[1]) / CELL_MM
            c = (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] - low[2]) / CELL_MM
            i = min(max(int(np.floor(a)), 0), asked.shape[0] - 1)
            j = min(max(int(np.floor(b)), 0), asked.shape[1] - 1)
            k = min(max(int(np.floor(c)), 0), asked.shape[2] - 1)
            wanted[v, u] = asked[i, j, k]


def _told(cells: _Cells, found: Sequence[Misfits]) -> _Texture:
    cell = np.concatenate([cells.find(one.points) for one in found])
    off = np.concatenate([one.misfit_mm for one in found])
    expected_mm = np.concatenate([one.expected_mm for one in found])
    known = np.bincount(cell, minlength=cells.count) >= FEWEST
    seen_mm = SIGMAS_PER_MEDIAN * _medians(off, cell, cells.count)
    sigmas = SIGMAS_PER_MEDIAN * _medians(off / expected_mm, cell, cells.count)
    noise_mm = _medians(expected_mm, cell, cells.count)
    relief_mm = np.sqrt(np.maximum(seen_mm**2 - noise_mm**2, 0.0))
    rough = known & (sigmas > ROUGH) & (seen_mm > ROUGH_MM)
    return _Texture(known, rough, known & (seen_mm < ROUGH_MM), relief_mm)


def _medians(values: Floats, group: Indices, count: int) -> Array:
    """Median of each group's values (N,), none of them negative; 0 for an empty group."""
    # The bits of non-negative floats sort like the floats: one sort of plain integers.
    bits = np.asarray(values, np.float32).view(np.uint32)
    keys = np.sort((group.astype(np.uint64) << np.uint64(32)) | bits)
    sizes = np.bincount(group, minlength=count)
    middle = (np.cumsum(sizes) - sizes + sizes // 2)[sizes > 0]
    found = np.zeros(count)
    found[sizes > 0] = keys[middle].astype(np.uint32).view(np.float32)
    return found
