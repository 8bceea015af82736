"""The images that a projector shows."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.errors import BadInput
from bodyscan.stripes.stripe_code import StripeCode


def pattern_frames(code: StripeCode, width: int, height: int) -> Bytes:
    """Images (F, height, width) uint8, read-only, in the order of the code's `image_counts`,
    followed by those of the crossing stripes.

    The stripes divide the projector's image evenly. Raises BadInput if they are narrower than one
    of its pixels, or if the instrument projects the code by itself.
    """
    ways = [_frames_one_way(way, width, height) for way in code.directions]
    return ways[0] if len(ways) == 1 else np.concatenate(ways)


def _frames_one_way(code: StripeCode, width: int, height: int) -> Bytes:
    side, across = ("height", height) if code.direction == "horizontal" else ("width", width)
    if code.stripes > across:
        raise BadInput(
            f"{code.stripes} stripes do not fit on {across} projector pixels",
            remedy=f"give the projector's own {side}, or project fewer stripes",
        )
    s = (np.arange(across) + 0.5) * code.stripes / across
    lines = np.concatenate([code.intensity(kind, s) for kind in code.image_counts])
    grey = np.rint(255.0 * lines).astype(np.uint8)
    grey = grey[:, :, None] if code.direction == "horizontal" else grey[:, None, :]
    return np.broadcast_to(grey, (len(grey), height, width))
