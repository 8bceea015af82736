"""Gray-coded stripes: the images for a projector, and reading camera images of them.

Reflected binary code, i ^ (i >> 1), most significant bit first, ceil(log2(stripes)) bits. From
one stripe to the next exactly one bit flips, so a pixel at a boundary is never off by more than
the stripe next to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.albedo_edges import Brightness, without_edges_across
from bodyscan.capture.boundaries import find_boundaries
from bodyscan.capture.grey_noise import noise_variance
from bodyscan.capture.rig import ProjectorSpec
from bodyscan.capture.sequence import check_codes, check_frames
from bodyscan.capture.stripe_coordinates import interpolate_stripes
from bodyscan.capture.stripe_images import StripeImages
from bodyscan.capture.views import StripeMap
from bodyscan.errors import BadInput

Images = NDArray[np.uint8]


def bits_needed(stripes: int) -> int:
    """Number of bits, and so of pattern frames, for this many stripes (>= 2)."""
    return (stripes - 1).bit_length()


def pattern_frames(spec: ProjectorSpec, width: int, height: int) -> Images:
    """Images to project, (bits, height, width) uint8 of 0 and 255; their inverses are 255 - these.

    The stripes divide the projector's image evenly. Raises BadInput if they are narrower than one
    of its pixels.
    """
    across = height if spec.direction == "horizontal" else width
    if spec.stripes > across:
        raise BadInput(
            f"{spec.stripes} stripes do not fit on {across} projector pixels",
            remedy="project fewer stripes",
        )
    stripe = np.arange(across) * spec.stripes // across
    gray = stripe ^ (stripe >> 1)
    shift = np.arange(bits_needed(spec.stripes))[::-1]
    lines = ((gray >> shift[:, None] & 1) * 255).astype(np.uint8)
    lines = lines[:, :, None] if spec.direction == "horizontal" else lines[:, None, :]
    return np.ascontiguousarray(np.broadcast_to(lines, (len(shift), height, width)))


def read_stripes(
    lit: NDArray[np.uint8],
    dark: NDArray[np.uint8] | None,
    patterns: Images,
    inverses: Images,
    *,
    stripes: int,
    direction: str,
) -> StripeMap:
    """The stripe coordinate of every pixel, from one pair's frames of one shot.

    lit, dark: (H, W); without a dark frame it is taken from the patterns and their inverses.
    patterns, inverses: (bits, H, W), most significant bit first. direction: the way the stripes
    run in the projector's image, "horizontal" or "vertical", and roughly in the camera's.

    Raises DecodingFailed, naming the frame where it can be told, if the frames do not add up.
    """
    check_frames(lit, dark, patterns, inverses, bits_needed(stripes))
    images = StripeImages.along_lines(lit, dark, patterns, inverses, direction)
    variance = noise_variance(images)
    codes, usable = images.decode(variance, stripes)
    check_codes(images, codes, usable, stripes)
    brightness = Brightness.of(images, variance)
    boundaries = find_boundaries(images, brightness, codes, usable, variance)
    s, sigma = interpolate_stripes(boundaries, codes, usable)
    s, sigma = without_edges_across(s, sigma, brightness, boundaries.blur2)
    return images.stripe_map(lit, s, sigma, boundaries, stripes)
