"""Whether the frames of a stripe sequence add up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.stripe_images import StripeImages
from bodyscan.errors import DecodingFailed


def check_frames(
    lit: NDArray[np.uint8],
    dark: NDArray[np.uint8] | None,
    patterns: NDArray[np.uint8],
    inverses: NDArray[np.uint8],
    bits: int,
) -> None:
    """Raises DecodingFailed if there are too few or too many frames, or of different sizes."""
    for name, frames in (("patterns", patterns), ("inverses", inverses)):
        if len(frames) != bits:
            raise DecodingFailed(
                f"{len(frames)} {name}, but the code has {bits} bits",
                remedy="give one pattern and one inverse for each bit, or correct `stripes`",
            )
        if frames.shape[1:] != lit.shape:
            raise DecodingFailed(f"{name} of {frames.shape[1:]} px, lit frame of {lit.shape} px")
    if dark is not None and dark.shape != lit.shape:
        raise DecodingFailed(f"dark frame of {dark.shape} px, lit frame of {lit.shape} px")


def check_codes(
    images: StripeImages, codes: NDArray[np.int32], usable: NDArray[np.bool_], stripes: int
) -> None:
    """first version"""
    if usable.mean() < 1e-3:
        raise DecodingFailed("no pixel is lit enough to be read")
