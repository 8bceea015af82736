"""How a print with markers shows in an image: as printed, white on black, or mirrored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Bytes


@dataclass(frozen=True)
class Appearance:
    """inverted: white where the print as described is black.  mirrored: seen in a mirror, or through
    the glass that it is printed on.  other_layout: its markers stand in the other of OpenCV's two
    historic layouts than the rig file says.  goes_on: markers follow beyond its last row."""

    inverted: bool = False
    mirrored: bool = False
    other_layout: bool = False
    goes_on: bool = False

    def as_printed(self, image: Bytes) -> Bytes:
        """The image (H, W) in which the board looks as printed."""
        seen = 255 - image if self.inverted else image
        return np.ascontiguousarray(seen[:, ::-1]) if self.mirrored else seen

    def in_image(self, pixels: Array, width: int) -> Array:
        """Pixels (..., 2) of `as_printed` in the image itself, `width` px wide."""
        if not self.mirrored:
            return pixels
        return np.stack([width - 1.0 - pixels[..., 0], pixels[..., 1]], axis=-1)


AS_PRINTED = Appearance()
OTHERWISE = (
    Appearance(inverted=True),
    Appearance(mirrored=True),
    Appearance(inverted=True, mirrored=True),
)
