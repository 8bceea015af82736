"""How well each pixel's ray is known, beyond what a motion of the whole camera would absorb."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats

ROWS, COLUMNS = 17, 21
"""Nodes across an image; the uncertainty is smooth between them."""


@dataclass(frozen=True, eq=False)
class RayUncertainty:
    """Standard deviations of a coordinate, px, at ROWS x COLUMNS nodes from the first pixel to the
    last.

    noise_px: due to the corners' noise.
    lens_px: due to the choice of lens model.
    """

    noise_px: Array
    lens_px: Array

    @property
    def sigma_px(self) -> Array:
        """Both combined, (ROWS, COLUMNS)."""
        return np.hypot(self.noise_px, self.lens_px)

    def inflate_noise(self, variances: float) -> RayUncertainty:
        """The same with the noise that many times larger, in variances."""
        return replace(self, noise_px=np.sqrt(variances) * self.noise_px)

    def image(self, width: int, height: int) -> Floats:
        """sigma_px (height, width) of every pixel, linear between nodes."""
        v = np.linspace(0.0, ROWS - 1.0, height, dtype=np.float32)
        u = np.linspace(0.0, COLUMNS - 1.0, width, dtype=np.float32)
        return cv2.remap(
            self.sigma_px.astype(np.float32), *np.meshgrid(u, v), interpolation=cv2.INTER_LINEAR
        )


def node_pixels(width: int, height: int) -> Array:
    """Pixels (ROWS, COLUMNS, 2) of the nodes."""
    u, v = np.linspace(0.0, width - 1.0, COLUMNS), np.linspace(0.0, height - 1.0, ROWS)
    return np.stack(np.meshgrid(u, v), axis=-1)
