"""Decoding: from the images of a stripe sequence to its stripe map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Greys
from bodyscan.errors import DecodingFailed, WrongDirection
from bodyscan.stripes.line_bands import LineBands
from bodyscan.stripes.stripe_code import ImageKind, SequenceImages, StripeCode
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import StripeMap


def decode_stripes(
    code: StripeCode,
    lit: Greys | None,
    dark: Greys | None,
    coded: Greys,
    *,
    limits: StripeLimits | None = None,
    bands: LineBands | None = None,
    where: str = "",
) -> StripeMap:
    """The stripe coordinate of every pixel, from one pair's images of one shot.

    lit, dark: (H, W); None if the code can do without (see docs/formats.md).
    coded: (F, H, W), the images of the code in the order of its `image_counts`, then those of the
        crossing stripes, which give the map's `crossing`.
    limits: the stripes that matter; others get no s.
    bands: where boundaries are wanted, and no s.

    Raises DecodingFailed, naming the image if it can be identified, for inconsistent images. If
    only those of the crossing stripes are inconsistent, the map is that of the others and says why.
    """
    try:
        own, *others = images_by_kind(code, coded)
        found = _decode(code, lit, dark, own, limits, bands)
        if code.crossing is None:
            return found
    except DecodingFailed as error:
        raise DecodingFailed(error.what, where=where, remedy=error.remedy) from error
    try:
        crossing = _decode(code.crossing, lit, dark, others[0], None, bands)
        return replace(found, crossing=crossing)
    except DecodingFailed as error:
        remedy = error.remedy
        if isinstance(error, WrongDirection):
            remedy = "exchange the lists of frames and of `crossing`, or correct `direction`"
        return replace(found, crossing_fault=f"{error.what}\n  {remedy}" if remedy else error.what)


def _decode(
    way: StripeCode,
    lit: Greys | None,
    dark: Greys | None,
    coded: Mapping[ImageKind, Greys],
    limits: StripeLimits | None,
    bands: LineBands | None,
) -> StripeMap:
    """The map of stripes that run one way."""
    shape = next(iter(coded.values())).shape[1:]
    if lit is None:
        lit = way.lit_from(coded)
    if lit.shape != shape:
        raise DecodingFailed(f"images of {shape} px, lit frame of {lit.shape} px")
    if dark is not None and dark.shape != shape:
        raise DecodingFailed(f"dark frame of {dark.shape} px, lit frame of {lit.shape} px")
    found = way.decode(SequenceImages(lit, dark, coded, bands), limits)
    if limits is None or found.beyond is not None:
        return found
    return restrict(found, limits)


def restrict(found: StripeMap, limits: StripeLimits) -> StripeMap:
    """The stripe map with s only between the limits."""
    kept, beyond = limits.split(found.s, np.isfinite(found.s))
    nothing = np.float32(np.nan)
    s, sigma = np.where(kept, found.s, nothing), np.where(kept, found.sigma, nothing)
    return replace(found, s=s, sigma=sigma, beyond=beyond)


def images_by_kind(code: StripeCode, coded: Greys) -> list[dict[ImageKind, Greys]]:
    """The images (F, H, W) of a code, and of the crossing stripes, by kind.

    Raises DecodingFailed if there are too few or too many.
    """
    counts = [way.image_counts for way in code.directions]
    ends = np.cumsum([number for each in counts for number in each.values()])
    if len(coded) != ends[-1]:
        raise DecodingFailed(
            f"{len(coded)} images of the code, but it has {ends[-1]}",
            remedy="give every image of the code, or correct `code` and `stripes`",
        )
    starts = [0, *ends[:-1]]
    parts = iter([coded[first:end] for first, end in zip(starts, ends, strict=True)])
    return [{kind: next(parts) for kind in each} for each in counts]
