"""Where in an image a checkerboard may be: where saddles of grey levels cluster.

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

BLUR_PX = 1.5
LIGHT_PX = 12.0
REACHES_PX = (16, 40)
REGIONS_EACH = 2
MIN_SHARE_OF_CORNERS = 0.7
MARGIN_PX = 20
MARGIN = 0.15
SCALES = (1.0, 0.5, 0.25)  # fine boards, blurred ones, large ones out of focus
NEIGHBOURS = 8
ASTRAY = 0.25  # of a step: opposite neighbours of a slanted board at its worst, and noise
LEAST_ANGLE = 0.3  # sine of the angle between the two directions
FEWEST_WITHIN = 4  # corners with neighbours all around; with fewer a lattice proves nothing
LEAST_WITHIN = 0.3  # of these look like a lattice on the poorest boards that a detector finds


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
        """That part of the image."""
        return np.ascontiguousarray(image[self.top : self.bottom, self.left : self.right])


def board_regions(image: Bytes, corners: int) -> list[Region]:
    """Parts of the image (H, W) with enough saddles for a board of that many corners.

    Clusters of saddles closer together than one of `REACHES_PX`; the largest first.
    """
    points, _ = _strongest_saddles(image, 4 * corners + 100)
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


def shows_lattice(image: Bytes, size: tuple[int, int]) -> bool:
    """Whether the image (H, W) may show size[0] x size[1] corners of a checkerboard, at one of
    `SCALES`.

    It takes a tenth of a second, all detectors take seconds. A corner of a board is a saddle whose
    neighbours lie opposite each other in two directions and fall where it rises. Skin, cloth,
    markers and noise have enough saddles, but few like that.
    """
    within = (size[0] - 2) * (size[1] - 2)
    if within < FEWEST_WITHIN:
        return True
    for scale in SCALES:
        reduced = image
        if scale != 1.0:
            reduced = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        saddles = _strongest_saddles(reduced, 4 * size[0] * size[1] + 100)
        if _like_a_lattice(*saddles) >= LEAST_WITHIN * within:
            return True
    return False


def _like_a_lattice(points: NDArray[np.intp], angles: Array) -> int:
    """How many saddles have neighbours as a board's corner has.

    points: (N, 2) px.
    angles: (N,) rad, direction in which each saddle rises.
    """
    if len(points) <= NEIGHBOURS:
        return 0
    near = np.asarray(cKDTree(points).query(points, NEIGHBOURS + 1)[1])[:, 1:]
    step = (points[near] - points[:, None]).astype(float)
    length = np.linalg.norm(step, axis=-1)
    opposite = np.cos(2.0 * (angles[near] - angles[:, None])) < -0.7
    apart = np.linalg.norm(step[:, :, None] + step[:, None], axis=-1)
    pairs = apart < ASTRAY * np.minimum(length[:, :, None], length[:, None])
    straight = (pairs & opposite[:, :, None] & opposite[:, None]).any(axis=2)
    way = step / length[..., None]
    across = np.abs(
        way[:, :, None, 0] * way[:, None, :, 1] - way[:, :, None, 1] * way[:, None, :, 0]
    )
    both = straight[:, :, None] & straight[:, None] & (across > LEAST_ANGLE)
    return int(both.any(axis=(1, 2)).sum())


def _strongest_saddles(image: Bytes, count: int) -> tuple[NDArray[np.intp], Array]:
    """The strongest saddles, at most `count`, (N, 2) px, by the Hessian's determinant relative to
    the contrast around, and the direction (N,) rad in which each rises most."""
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
    at = row[strongest], column[strongest]
    angles = 0.5 * np.arctan2(2.0 * xy[at], xx[at] - yy[at]).astype(np.float64)
    return np.stack(at[::-1], axis=-1), angles
