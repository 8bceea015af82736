"""Decoding: from the images of a stripe sequence to its stripe map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Greys
from bodyscan.errors import DecodingFailed, WrongDirection
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
    where: str = "",
) -> StripeMap:
    """Compute the stripe coordinate of every pixel from one pair's images of one shot.

    lit, dark: (H, W); None if the code can do without (see docs/formats.md).
    coded: (F, H, W) in the order of the code's `image_counts`, then those of the crossing stripes.
    limits: the stripes that matter; others get no s.

    Raises DecodingFailed for inconsistent images; `crossing_fault` says so of crossing ones.
    """
    try:
        images, *crossing_images = split_by_kind(code, coded)
        stripes = _decode_direction(code, lit, dark, images, limits)
        if code.crossing is None:
            return stripes
    except DecodingFailed as error:
        step, remedy = describe_step(code, lit, dark, coded), error.remedy
        if step:
            remedy = "let the camera begin that much earlier or later, or rename the files"
        raise DecodingFailed(step or error.what, where=where, remedy=remedy) from error
    try:
        crossing = _decode_direction(code.crossing, lit, dark, crossing_images[0], None)
        return replace(stripes, crossing=crossing)
    except DecodingFailed as error:
        remedy = error.remedy
        if isinstance(error, WrongDirection):
            remedy = "exchange the lists of frames and of `crossing`, or correct `direction`"
        fault = f"{error.what}\n  {remedy}" if remedy else error.what
        return replace(stripes, crossing_fault=fault)


def describe_step(code: StripeCode, lit: Greys | None, dark: Greys | None, coded: Greys) -> str:
    """Say by how many frames a sequence is out of step, "" if it is in step.

    The lit image is the brightest at nearly every pixel, the dark one the darkest. Frames follow one
    another as files do, each pattern before its inverse, or in the best order to show them.
    """
    files = np.arange(sum(code.image_counts.values()))
    dark = dark if code.uses_dark else np.zeros_like(coded[0])
    if lit is None or dark is None or not 2 < len(files) <= len(coded):
        return ""
    levels = np.stack([lit, dark, *coded[: len(files)]])[:, ::4, ::4].astype(np.float32)
    contrast = np.ptp(levels, axis=0)
    if not (contrast > 20.0).any():
        return ""
    shares = (levels - levels.min(axis=0))[:, contrast > 20.0] / contrast[contrast > 20.0]
    is_lit, is_dark = (np.mean(x, axis=1) > 0.9 for x in (shares > 0.8, shares < 0.2))
    if not code.uses_dark:  # of a sweep no other image is lit all over
        late = int(np.argmax(np.delete(is_lit, 1)))
        late -= (len(files) + 1) * (late > len(files) / 2)
        return _format_step(late) if late else ""
    by_bit = files.reshape(2, -1).T.ravel() if len(files) % 2 == 0 else files
    orders = [[0, 1, *(2 + np.array(order))] for order in (files, by_bit, code.show_order)]
    early = not is_lit[1]  # begun one early, the lit image is lost; else dark and lit are exchanged
    ends, inverted = is_lit | is_dark, [kind.name for kind in code.image_counts][1:] == ["inverse"]

    def agree(order: list[int], late: int) -> bool:
        """Whether patterns and inverses, taken from that many files later, complement one another."""
        at = np.argsort(order)[2:].reshape(2, -1) + late
        at = at[:, (at < len(order)).all(axis=0)]
        first, second = shares[np.array(order)[at]]
        return at.size > 0 and bool(np.mean(np.abs(first + second - 1.0)) < 0.25)

    # Of sequences that are shown again and again, images that are lost in front are found at the end.
    for late in sorted(range(-len(files), len(files) + 1), key=lambda late: (abs(late), late < 0)):
        for o in orders:
            # Where a bit is the same all over, its pattern and inverse are as lit and dark; but files
            # that begin with later images do not end with stripes, and have inverses elsewhere.
            sound = late < 1 or (not ends[o[-1]] and (not inverted or agree(o, late)))
            begun = is_lit[o[late]] or (late == -1 and early)
            if sound and begun and is_dark[o[late + 1]]:
                return _format_step(late) if late else ""
    return ""


def _format_step(late: int) -> str:
    side = f"{abs(late)} {'before' if late > 0 else 'after'}"
    return f"the frames are out of step by {abs(late)}: each file holds that {side} its own"


def _decode_direction(
    code: StripeCode,
    lit: Greys | None,
    dark: Greys | None,
    coded: Mapping[ImageKind, Greys],
    limits: StripeLimits | None,
) -> StripeMap:
    """Decode the stripes of one direction."""
    lit = code.lit_from(coded) if lit is None else lit
    stripes = code.decode(SequenceImages(lit, dark, coded), limits)
    if limits is None or stripes.beyond is not None:
        return stripes
    kept, beyond = limits.split(stripes.s, np.isfinite(stripes.s))
    s, sigma = (np.where(kept, each, np.float32(np.nan)) for each in (stripes.s, stripes.sigma))
    return replace(stripes, s=s, sigma=sigma, beyond=beyond)


def split_by_kind(code: StripeCode, coded: Greys) -> list[dict[ImageKind, Greys]]:
    """Split the images (F, H, W) of a code by kind, and those of the crossing stripes."""
    counts = [direction.image_counts for direction in code.directions]
    ends = np.cumsum([number for each in counts for number in each.values()])
    starts = [0, *ends[:-1]]
    parts = iter([coded[first:end] for first, end in zip(starts, ends, strict=True)])
    return [{kind: next(parts) for kind in each} for each in counts]
