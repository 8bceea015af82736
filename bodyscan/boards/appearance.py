"""How a print with markers appears in an image: as printed, white on black, or mirrored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Bytes


@dataclass(frozen=True)
class Appearance:
    """How a board differs from its description.

    inverted: white where the print as described is black.
    mirrored: seen in a mirror, or through the glass it is printed on.
    other_layout: its markers follow OpenCV's other historic layout, not the one in the rig file.
    goes_on: more markers follow beyond its last row.
    """

    inverted: bool = False
    mirrored: bool = False
    other_layout: bool = False
    goes_on: bool = False

    def as_printed(self, image: Bytes) -> Bytes:
        """The image (H, W) with the board as printed."""
        seen = 255 - image if self.inverted else image
        return np.ascontiguousarray(seen[:, ::-1]) if self.mirrored else seen

    def in_image(self, pixels: Array, width: int) -> Array:
        """Map pixels (..., 2) of `as_printed` to the image itself, which is `width` px wide."""
        if not self.mirrored:
            return pixels
        return np.stack([width - 1.0 - pixels[..., 0], pixels[..., 1]], axis=-1)


AS_PRINTED = Appearance()
OTHERWISE = (
    Appearance(inverted=True),
    Appearance(mirrored=True),
    Appearance(inverted=True, mirrored=True),
)
