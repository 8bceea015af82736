"""The range image: what one pair saw of a subject, with a sigma for every point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Bytes, Floats, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.crop import Crop
from bodyscan.geometry.velocity import Velocity
from bodyscan.reconstruction.two_ways import Agreement


@dataclass(frozen=True, eq=False)
class RangeImage:
    """What one pair saw of a subject, on the camera's pixel grid, camera frame.

    (height, width) is the camera's image, (h, w) the part of it that is kept: all, unless `cut`.

    points: (h, w, 3) float32, mm.
    normals: (h, w, 3) float32, unit, towards the camera; NaN at the rim of a surface.
    sigma_mm: (h, w) float32, standard deviation of the point along its viewing ray; NaN
    where nothing was measured, whatever stands in the others.
    colours: (h, w) uint8, grey level of the lit image.
    beyond: (h, w) bool, where the camera saw something behind the scan volume; None if all
    that was seen has a point.
    agreement: of stripes of two directions, if such were projected.
    time_ms: the one moment for which the depths stand, ms since the scan began; None if not known.
    velocity: of the body at that moment; None where the stripes or the times do not tell it.
    common_mm: (h, w) float32, of sigma_mm the part that neighbours share, since it comes of
    the calibration: it does not shrink where they are averaged. None: there is none.
    bent: whether points were since carried to another moment, off the rays of their pixels.
    corner: row and column of the camera's image at which the kept part begins.
    whole_depth, whole_colours: of one that was cut, `open_depth` and `lit` from before.
    """

    pair: str
    camera: Camera
    points: Floats
    normals: Floats
    sigma_mm: Floats
    colours: Bytes
    beyond: Mask | None = None
    agreement: Agreement | None = None
    time_ms: float | None = None
    velocity: Velocity | None = None
    common_mm: Floats | None = None
    bent: bool = False
    corner: tuple[int, int] = (0, 0)
    whole_depth: Floats | None = None
    whole_colours: Bytes | None = None

    @property
    def valid(self) -> Mask:
        """(h, w): where a point was measured."""
        return np.isfinite(self.sigma_mm)

    @property
    def open_depth(self) -> Floats:
        """(height, width): how deep the camera saw, z, mm; inf behind the scan volume, 0 if unknown."""
        if self.whole_depth is not None:
            return self.whole_depth
        depth = np.where(self.valid, self.points[..., 2], np.float32(0.0))
        return depth if self.beyond is None else np.where(self.beyond, np.float32(np.inf), depth)

    @property
    def part(self) -> Crop:
        """Rows and columns of the camera's image that are kept."""
        (top, left), (rows, columns) = self.corner, self.sigma_mm.shape
        return slice(top, top + rows), slice(left, left + columns)

    @property
    def lit(self) -> Bytes:
        """(height, width): the lit image."""
        return self.colours if self.whole_colours is None else self.whole_colours

    def every(self, step: int, first: int = 0) -> Crop:
        """Of the kept part every so many rows and columns, counted in the camera's image: the same
        pixels whatever is kept."""
        top, left = self.corner
        return slice((first - top) % step, None, step), slice((first - left) % step, None, step)

    def cut(self, box: Crop) -> RangeImage:
        """With points in a box of the kept part alone: a third of the memory where that is a body.

        How deep the camera saw, and its image, stay whole.
        """
        top, left = self.corner
        common = None if self.common_mm is None else self.common_mm[box].copy()
        return replace(
            self,
            points=self.points[box].copy(),
            normals=self.normals[box].copy(),
            sigma_mm=self.sigma_mm[box].copy(),
            colours=self.colours[box].copy(),
            common_mm=common,
            beyond=None,
            corner=(top + box[0].start, left + box[1].start),
            whole_depth=self.open_depth,
            whole_colours=self.lit,
        )
