"""A camera's rays: several through each pixel, and one between pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.simulation.lens import TrueCamera, sample_directions
from bodyscan.simulation.settings import Optics

_BAND = 250_000


@dataclass(frozen=True, eq=False)
class Band:
    """Part of an image, R rows and C columns, and its rays, z = 1.

    rays: (R, C, K, 3) through places inside pixels.
    shift: (R, C, 2) by which these places were moved from `lens.sample_offsets`.
    corners: (R + 1, C + 1, 3) through the pixels' corners.
    """

    rows: slice
    columns: slice
    rays: Floats
    shift: Floats
    corners: Floats

    @staticmethod
    def of(camera: TrueCamera, samples: int, rng: np.random.Generator, rows: slice) -> Band:
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

    def between(self, first: int, last: int) -> Band:
        """Its columns from first to last, both included."""
        cut = slice(first, last + 1)
        return replace(
            self,
            columns=cut,
            rays=self.rays[:, cut],
            shift=self.shift[:, cut],
            corners=self.corners[:, first : last + 2],
        )

    @property
    def place(self) -> tuple[slice, slice]:
        """Slices of its pixels in an image."""
        return self.rows, self.columns


@dataclass(frozen=True, eq=False)
class View:
    """A camera's rays, kept for all its shots; the bands cover its image."""

    camera: TrueCamera
    optics: Optics
    bands: tuple[Band, ...]

    @staticmethod
    def of(camera: TrueCamera, optics: Optics, rng: np.random.Generator) -> View:
        """Rays through places inside each pixel, shifted by `rng`."""
        rows = max(1, _BAND // (camera.width * optics.samples**2))
        cuts = [slice(r, min(r + rows, camera.height)) for r in range(0, camera.height, rows)]
        bands = (Band.of(camera, optics.samples, rng, cut) for cut in cuts)
        return View(camera, optics, tuple(bands))

    def around(self, chosen: Mask) -> Iterator[Band]:
        """The bands that contain chosen pixels (H, W), cut to the columns from first to last."""
        for band in self.bands:
            columns = np.flatnonzero(chosen[band.rows].any(axis=0))
            if columns.size:
                yield band.between(int(columns[0]), int(columns[-1]))
