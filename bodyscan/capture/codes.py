"""Gray-coded stripes: the images for a projector, and reading camera images of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.albedo_edges import Brightness, without_edges_across
from bodyscan.capture.boundaries import find_boundaries
from bodyscan.capture.gray_code import bits_needed, gray_from_stripe, stripe_from_gray
from bodyscan.capture.grey_noise import noise_variance
from bodyscan.capture.rig import ProjectorSpec
from bodyscan.capture.sequence import check_codes, check_exposure, check_frames
from bodyscan.capture.stripe_coordinates import interpolate_stripes
from bodyscan.capture.stripe_images import StripeImages
from bodyscan.capture.views import StripeMap
from bodyscan.errors import BadInput

Images = NDArray[np.uint8]


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
    gray = gray_from_stripe(stripe)
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
    check_exposure(images)
    gray = images.gray()
    check_codes(images, gray, stripes)
    codes = stripe_from_gray(gray)
    variance = noise_variance(images)
    usable = images.usable(codes, variance, stripes)
    brightness = Brightness.of(images, variance, usable)
    boundaries = find_boundaries(images, brightness, codes, usable, variance)
    s, sigma = interpolate_stripes(boundaries, codes, usable)
    s, sigma = without_edges_across(s, sigma, brightness, boundaries.blur2)
    return images.stripe_map(lit, s, sigma, boundaries, stripes)
