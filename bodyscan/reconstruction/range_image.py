"""The range image: what one pair measured of a subject, with a standard deviation per point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Bytes, Crop, Floats, Mask
from bodyscan.geometry.camera import Camera

MAX_RATIO = 2.0
"""Sigmas by which the directions may typically differ. Beyond, sigmas lack most of the error (an
imported calibration's lack all of its own) and cannot weight the directions."""


@dataclass(frozen=True)
class Agreement:
    """How well the two directions agree."""

    # Robust sigma of the difference of both depths along the rays, in their own sigmas.
    offset_sigmas: float
    offset_stripes: float  # the same in stripes of the less depth-sensitive direction
    stripes: int  # number of stripes of that direction

    @property
    def unusual(self) -> bool:
        """Whether the calibration, not noise, is off by more than usual.

        By 0.002 of the projector's image: calibrations reproject to half a pixel or one of some 1000.
        """
        return self.offset_sigmas > MAX_RATIO and self.offset_stripes > 2e-3 * self.stripes

    @property
    def impossible(self) -> bool:
        """Whether no right calibration is off by so much.

        By 0.02 of the projector's image, half a degree: a wrong pose, sign or number of stripes.
        """
        return self.unusual and self.offset_stripes > 2e-2 * self.stripes

    @property
    def description(self) -> str:
        return (
            f"{self.offset_stripes:.1f} of {self.stripes} stripes of the less depth-sensitive "
            f"direction ({self.offset_sigmas:.1f} sigmas)"
        )


@dataclass(frozen=True, eq=False)
class RangeImage:
    """What one pair measured of a subject, on the camera's pixel grid, camera frame.

    (height, width) is the camera's image, (h, w) the part of it that is kept: all, unless cropped.

    points: (h, w, 3) float32, mm.
    normals: (h, w, 3) float32, unit, towards the camera; NaN at the margin of a surface.
    sigma_mm: (h, w) float32, standard deviation of the point along its viewing ray; NaN where
        nothing was measured, whatever the other arrays hold there.
    colours: (h, w) uint8, grey level of the lit image.
    beyond: (h, w) bool, where the visible surface is behind the scan volume; None if every measured
        pixel has a point.
    agreement: of stripes of two directions, if both were projected.
    time_ms: the moment for which the depths hold, ms since the scan began; None if not known.
    span_ms: when its first and its last frame were taken.
    common_mm: (h, w) float32, the part of sigma_mm that neighbours share because it comes from the
        calibration: it does not shrink when they are averaged. None if there is none.
    warped: whether points were displaced to another moment, off the rays of their pixels.
    corner: row and column of the camera's image at which the kept part begins.
    saturated: share of the pixels lit by stripes of the scan volume that are white.
    nonlinearity: how far grey levels are from proportional to light, see `StripeMap`.
    rgb: (h, w, 3) uint8, red, green and blue of the lit image; None of a grey camera.
    whole_depth, whole_colours: `open_depth` and `lit` from before cropping.
    correlation_px: distance along rows and columns within which noise is correlated, because depths
        come from the same stripe boundaries; 0 if it is independent.
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
    span_ms: tuple[float, float] | None = None
    common_mm: Floats | None = None
    warped: bool = False
    corner: tuple[int, int] = (0, 0)
    whole_depth: Floats | None = None
    whole_colours: Bytes | None = None
    correlation_px: tuple[float, float] = (0.0, 0.0)
    saturated: float = 0.0
    nonlinearity: float = 0.0
    rgb: Bytes | None = None

    @property
    def valid(self) -> Mask:
        """(h, w): where a point was measured."""
        return np.isfinite(self.sigma_mm)

    @property
    def overexposed(self) -> bool:
        """Whether what is left are rims and folds, and many of those are wrong."""
        return self.saturated > 0.3

    @property
    def nonlinear(self) -> bool:
        """Whether grey levels are far from proportional to light: linear cameras of three rigs have a
        `nonlinearity` of -0.12 to 0.01, with a gamma of 2.2 0.13 to 0.37, a consumer's 0.3."""
        return self.nonlinearity > 0.12

    @property
    def open_depth(self) -> Floats:
        """(height, width): visible depth z, mm; inf behind the scan volume, 0 if unknown."""
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

    def subsample(self, step: int, first: int = 0) -> Crop:
        """Every n-th row and column of the camera's image: the same pixels whatever part is kept."""
        top, left = self.corner
        return slice((first - top) % step, None, step), slice((first - left) % step, None, step)

    def crop(self, box: Crop) -> RangeImage:
        """Crop to a box of the kept part: a third of the memory when that is a body.

        `open_depth` and `lit` stay whole.
        """
        top, left = self.corner
        common = None if self.common_mm is None else self.common_mm[box].copy()
        return replace(
            self,
            points=self.points[box].copy(),
            normals=self.normals[box].copy(),
            sigma_mm=self.sigma_mm[box].copy(),
            colours=self.colours[box].copy(),
            rgb=None if self.rgb is None else self.rgb[box].copy(),
            common_mm=common,
            beyond=None,
            corner=(top + box[0].start, left + box[1].start),
            whole_depth=self.open_depth,
            whole_colours=self.lit,
        )
