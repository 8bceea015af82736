"""From what a camera saw of a stripe sequence to its stripe map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.stripe_code import SequenceImages, StripeCode
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import StripeMap


def decode_stripes(
    code: StripeCode,
    lit: Bytes,
    dark: Bytes | None,
    coded: Bytes,
    *,
    limits: StripeLimits | None = None,
    where: str = "",
) -> StripeMap:
    """The stripe coordinate of every pixel, from one pair's images of one shot.

    lit, dark: (H, W); dark may be None if the code can do without (see docs/formats.md).
    coded: (F, H, W), the images of the code in the order of its `image_counts`.
    limits: the stripes that matter; others get no s.

    Raises DecodingFailed, naming the image where it can be told, if they do not add up.
    """
    try:
        images = _by_kind(code, lit, dark, coded)
        found = code.decode(images, limits)
    except DecodingFailed as error:
        raise DecodingFailed(error.what, where=where, remedy=error.remedy) from error
    if limits is None or found.beyond is not None:
        return found
    return restrict(found, limits)


def restrict(found: StripeMap, limits: StripeLimits) -> StripeMap:
    """The stripe map with s between the limits only."""
    kept, beyond = limits.split(found.s, np.isfinite(found.s))
    nothing = np.float32(np.nan)
    s, sigma = np.where(kept, found.s, nothing), np.where(kept, found.sigma, nothing)
    return replace(found, s=s, sigma=sigma, beyond=beyond)


def _by_kind(code: StripeCode, lit: Bytes, dark: Bytes | None, coded: Bytes) -> SequenceImages:
    """Raises DecodingFailed if there are too few or too many frames, or of different sizes."""
    counts = code.image_counts
    ends = np.cumsum(list(counts.values()))
    if len(coded) != ends[-1]:
        raise DecodingFailed(
            f"{len(coded)} images of the code, but it has {ends[-1]}",
            remedy="give every image of the code, or correct `code` and `stripes`",
        )
    if coded.shape[1:] != lit.shape:
        raise DecodingFailed(f"images of {coded.shape[1:]} px, lit frame of {lit.shape} px")
    if dark is not None and dark.shape != lit.shape:
        raise DecodingFailed(f"dark frame of {dark.shape} px, lit frame of {lit.shape} px")
    return SequenceImages(lit, dark, dict(zip(counts, np.split(coded, ends[:-1]), strict=True)))
