"""Narrow dark gaps between bright surfaces, where a pixel's light is its neighbours' blur.

Into the gap between two toes hardly any light falls, and less comes back. What a camera sees there is
the blur of the bright skin on both sides, with their stripes: it is measured as a bridge from one
side to the other, smooth, and seen alike by other cameras.
"""

from __future__ import annotations

import cv2
import numpy as np

from bodyscan.arrays import Bytes, Mask

WIDEST_PX = 7  # of the gap and half of its slopes: several times the blur
DARKER = 2.0  # times, than the surfaces around
MARGIN_PX = 1  # beside what is so dark, where the two mix
LEAST_STEP = 30  # grey levels; less may be noise on something dark


def dark_gaps(grey: Bytes) -> Mask:
    """(height, width) pixels of an image (height, width) that lie in a narrow dark gap or at its rim.

    A morphological closing fills what is narrower than its window and has brighter surfaces on both
    sides; something dark and wide (hair, cloth, the background beside a silhouette) stays.
    """
    window = np.ones((WIDEST_PX, WIDEST_PX), np.uint8)
    around = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, window).astype(np.float32)
    dark = (around > DARKER * grey) & (around >= grey + np.float32(LEAST_STEP))
    margin = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    return cv2.dilate(dark.view(np.uint8), margin).view(bool)
