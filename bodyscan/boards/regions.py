"""Where in an image a checkerboard may be: where saddles of grey crowd together.

OpenCV's quick detector finds fine, slanted or dim boards more readily in a picture of the board
alone; and where saddles are missing no detector need be asked.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes

BLUR_PX = 1.5
LIGHT_PX = 12.0
REACHES_PX = (16, 40)
REGIONS_EACH = 2
MIN_SHARE_OF_CORNERS = 0.7
MARGIN_PX = 20
MARGIN = 0.15


@dataclass(frozen=True)
class Region:
    """Columns left to right - 1 and rows top to bottom - 1 of an image, px."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        """px^2."""
        return (self.right - self.left) * (self.bottom - self.top)

    def cut(self, image: Bytes) -> Bytes:
        """That part of the image."""
        return np.ascontiguousarray(image[self.top : self.bottom, self.left : self.right])


def board_regions(image: Bytes, corners: int) -> list[Region]:
    """Parts of the image (H, W) that hold saddles enough for a board of that many corners.

    Clusters of saddles nearer to each other than one of `REACHES_PX`; the largest first.
    """
    points = _strongest_saddles(image, 4 * corners + 100)
    height, width = image.shape
    marks = np.zeros((height, width), np.uint8)
    marks[points[:, 1], points[:, 0]] = 1
    regions: list[Region] = []
    for reach in REACHES_PX:
        grown = cv2.dilate(marks, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        label = cv2.connectedComponents(grown)[1][points[:, 1], points[:, 0]]
        sizes = np.bincount(label)
        for largest in np.argsort(-sizes, kind="stable")[:REGIONS_EACH]:
            if sizes[largest] < MIN_SHARE_OF_CORNERS * corners:
                break
            members = points[label == largest]
            low, high = members.min(axis=0), members.max(axis=0)
            margin = MARGIN * (high - low) + MARGIN_PX
            left, top = np.maximum(low - margin, 0).astype(int)
            right, bottom = np.minimum(high + margin + 1, [width, height]).astype(int)
            region = Region(int(left), int(top), int(right), int(bottom))
            if region not in regions:
                regions.append(region)
    return regions


def _strongest_saddles(image: Bytes, count: int) -> NDArray[np.intp]:
    """The (at most) `count` strongest saddles, (N, 2) px, by the Hessian's determinant measured
    against the contrast around."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1)
    difference = cv2.absdiff(smooth, cv2.GaussianBlur(smooth, (0, 0), LIGHT_PX))
    contrast = cv2.GaussianBlur(difference, (0, 0), LIGHT_PX) + 3.0
    saddle = (xy * xy - xx * yy) / contrast**2
    peaks = (saddle > 0) & (saddle == cv2.dilate(saddle, np.ones((5, 5), np.uint8)))
    row, column = np.nonzero(peaks)
    strongest = np.argsort(-saddle[row, column], kind="stable")[:count]
    return np.stack([column[strongest], row[strongest]], axis=-1)
