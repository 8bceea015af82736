"""The range image: what one pair saw of a subject, with a sigma for every point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Bytes, Floats, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.velocity import Velocity
from bodyscan.reconstruction.two_ways import Agreement


@dataclass(frozen=True, eq=False)
class RangeImage:
    """What one pair saw of a subject, on the camera's pixel grid, camera frame.

    points: (height, width, 3) float32, mm.
    normals: (height, width, 3) float32, unit, towards the camera; NaN at the rim of a surface.
    sigma_mm: (height, width) float32, standard deviation of the point along its viewing ray; NaN
    where nothing was measured, whatever stands in the others.
    colours: (height, width) uint8, grey level of the lit image.
    beyond: (height, width) bool, where the camera saw something behind the scan volume; None if all
    that was seen has a point.
    agreement: of stripes of two directions, if such were projected.
    time_ms: the one moment for which the depths stand, ms since the scan began; None if not known.
    velocity: of the body at that moment; None where the stripes or the times do not tell it.
    common_mm: (height, width) float32, of sigma_mm the part that neighbours share, since it comes of
    the calibration: it does not shrink where they are averaged. None: there is none.
    bent: whether points were since carried to another moment, off the rays of their pixels.
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

    @property
    def valid(self) -> Mask:
        """(height, width): where a point was measured."""
        return np.isfinite(self.sigma_mm)

    @property
    def open_depth(self) -> Floats:
        """(height, width): how deep the camera saw, z, mm; inf behind the scan volume, 0 if unknown."""
        depth = np.where(self.valid, self.points[..., 2], np.float32(0.0))
        return depth if self.beyond is None else np.where(self.beyond, np.float32(np.inf), depth)
