"""Find the regions of an image that may show a checkerboard: clusters of saddles of grey levels.

OpenCV's quick detector finds fine, slanted or dim boards more readily in an image of the board
alone; and where there are no saddles no detector need be run.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Bytes


@dataclass(frozen=True)
class Region:
    """Columns left to right - 1 and rows top to bottom - 1 of an image, px."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        """Area in px^2."""
        return (self.right - self.left) * (self.bottom - self.top)

    def cut(self, image: Bytes) -> Bytes:
        """The region of the image."""
        return np.ascontiguousarray(image[self.top : self.bottom, self.left : self.right])


def board_regions(image: Bytes, corners: int) -> list[Region]:
    """Find regions of the image (H, W) with enough saddles for a board of that many corners.

    Saddles are clustered at two distances; the two largest clusters of each count.
    """
    points, _ = _strongest_saddles(image, 4 * corners + 100)
    height, width = image.shape
    marks = np.zeros((height, width), np.uint8)
    marks[points[:, 1], points[:, 0]] = 1
    regions: list[Region] = []
    for reach in (16, 40):  # px
        grown = cv2.dilate(marks, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        label = cv2.connectedComponents(grown)[1][points[:, 1], points[:, 0]]
        sizes = np.bincount(label)
        for largest in np.argsort(-sizes, kind="stable")[:2]:
            if sizes[largest] < 0.7 * corners:
                break
            members = points[label == largest]
            low, high = members.min(axis=0), members.max(axis=0)
            margin = 0.15 * (high - low) + 20
            left, top = np.maximum(low - margin, 0).astype(int)
            right, bottom = np.minimum(high + margin + 1, [width, height]).astype(int)
            region = Region(int(left), int(top), int(right), int(bottom))
            if region not in regions:
                regions.append(region)
    return regions


def shows_lattice(image: Bytes, size: tuple[int, int]) -> bool:
    """Whether the image (H, W) may show size[0] x size[1] corners of a checkerboard.

    It takes a tenth of a second, all detectors take seconds. A corner of a board is a saddle whose
    neighbours lie opposite each other in two directions and fall where it rises. Skin, cloth,
    markers and noise have enough saddles, but few like that.
    """
    interior = (size[0] - 2) * (size[1] - 2)
    if interior < 4:
        return True
    for scale in (1.0, 0.5, 0.25):  # fine boards, blurred ones, large ones out of focus
        reduced = image
        if scale != 1.0:
            reduced = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        saddles = _strongest_saddles(reduced, 4 * size[0] * size[1] + 100)
        if _count_lattice_points(*saddles) >= 0.3 * interior:
            return True
    return False


def _count_lattice_points(points: NDArray[np.intp], angles: Array) -> int:
    """Count the saddles whose neighbours lie as those of a board's corner.

    points: (N, 2) px.
    angles: (N,) rad, direction in which each saddle rises.
    """
    neighbours = 8
    if len(points) <= neighbours:
        return 0
    near = np.asarray(cKDTree(points).query(points, neighbours + 1)[1])[:, 1:]
    step = (points[near] - points[:, None]).astype(float)
    length = np.linalg.norm(step, axis=-1)
    opposite = np.cos(2.0 * (angles[near] - angles[:, None])) < -0.7
    asymmetry = np.linalg.norm(step[:, :, None] + step[:, None], axis=-1)
    # A quarter of a step covers the most slanted board and noise.
    pairs = asymmetry < 0.25 * np.minimum(length[:, :, None], length[:, None])
    straight = (pairs & opposite[:, :, None] & opposite[:, None]).any(axis=2)
    unit = step / length[..., None]
    sine = np.abs(
        unit[:, :, None, 0] * unit[:, None, :, 1] - unit[:, :, None, 1] * unit[:, None, :, 0]
    )
    both = straight[:, :, None] & straight[:, None] & (sine > 0.3)
    return int(both.any(axis=(1, 2)).sum())


def _strongest_saddles(image: Bytes, count: int) -> tuple[NDArray[np.intp], Array]:
    """Find the `count` strongest saddles (N, 2) px, and the direction (N,) rad in which each rises.

    Strength is the Hessian's negative determinant relative to the local contrast.
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1)
    difference = cv2.absdiff(smooth, cv2.GaussianBlur(smooth, (0, 0), 12.0))
    contrast = cv2.GaussianBlur(difference, (0, 0), 12.0) + 3.0
    saddle = (xy * xy - xx * yy) / contrast**2
    peaks = (saddle > 0) & (saddle == cv2.dilate(saddle, np.ones((5, 5), np.uint8)))
    row, column = np.nonzero(peaks)
    strongest = np.argsort(-saddle[row, column], kind="stable")[:count]
    at = row[strongest], column[strongest]
    angles = 0.5 * np.arctan2(2.0 * xy[at], xx[at] - yy[at]).astype(np.float64)
    return np.stack(at[::-1], axis=-1), angles
