"""The codes by which stripes are told apart: what to project, and reading what a camera saw of it.

`ProjectorSpec.code` says which; `ProjectorSpec.frame_counts` which images it takes, in order.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.errors import BadInput, DecodingFailed
from bodyscan.stripes import bit_codes, light_section, phase_shift, stripe_index
from bodyscan.stripes.projector_spec import FrameKind, ProjectorSpec
from bodyscan.stripes.sequence import check_sizes
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.wanted_stripes import WantedStripes

Images = NDArray[np.uint8]


def pattern_frames(spec: ProjectorSpec, width: int, height: int) -> Images:
    """Images to project, (F, height, width) uint8, read-only, in the order of `spec.frame_counts`.

    The stripes divide the projector's image evenly. Raises BadInput if they are narrower than one
    of its pixels, or if the code is one that its instrument projects by itself.
    """
    if spec.code == "stripe-index":
        raise BadInput(
            "a stripe-index image is what an instrument hands out: it projects stripes of its own",
            remedy="choose another code for a projector that shows images",
        )
    across = height if spec.direction == "horizontal" else width
    if spec.stripes > across:
        raise BadInput(
            f"{spec.stripes} stripes do not fit on {across} projector pixels",
            remedy="project fewer stripes",
        )
    s = (np.arange(across) + 0.5) * spec.stripes / across
    lines = np.concatenate([_light(kind, spec, s) for kind in spec.frame_counts])
    grey = np.rint(255.0 * lines).astype(np.uint8)
    grey = grey[:, :, None] if spec.direction == "horizontal" else grey[:, None, :]
    return np.broadcast_to(grey, (len(grey), height, width))


def _light(kind: FrameKind, spec: ProjectorSpec, s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Light, 0 to 1, of the images of one kind at stripe coordinates s (N,): (images, N)."""
    if kind == "phase":
        return phase_shift.light(spec, s)
    if kind == "stripe":
        return light_section.light(spec, s)
    bits = bit_codes.light(spec, s)
    return bits if kind == "pattern" else 1.0 - bits


def read_code(
    spec: ProjectorSpec,
    lit: Images,
    dark: Images | None,
    coded: Images,
    *,
    wanted: WantedStripes | None = None,
    where: str = "",
) -> StripeMap:
    """The stripe coordinate of every pixel, from one pair's images of one shot.

    lit, dark: (H, W); dark may be None if the code can do without (see docs/formats.md).
    coded: (F, H, W), the images of the code in the order of `spec.frame_counts`.
    wanted: the stripes that matter; others get no s.

    Raises DecodingFailed, naming the image where it can be told, if they do not add up.
    """
    try:
        check_sizes(lit, dark, coded, sum(spec.frame_counts.values()))
        if spec.code in ("gray", "binary"):
            return bit_codes.read(spec, lit, dark, coded, wanted)
        readers = {
            "light-section": light_section.read,
            "stripe-index": stripe_index.read,
            "phase-shift": phase_shift.read,
        }
        found = readers[spec.code](spec, lit, dark, coded)
        return found if wanted is None else only(found, wanted)
    except DecodingFailed as error:
        raise DecodingFailed(error.what, where=where, remedy=error.remedy) from error


def only(found: StripeMap, wanted: WantedStripes) -> StripeMap:
    """The stripe map with s where it is wanted."""
    kept, beyond = wanted.split(found.s, np.isfinite(found.s))
    nothing = np.float32(np.nan)
    s, sigma = np.where(kept, found.s, nothing), np.where(kept, found.sigma, nothing)
    return replace(found, s=s, sigma=sigma, beyond=beyond)


def read_stripes(
    lit: Images,
    dark: Images | None,
    patterns: Images,
    inverses: Images,
    *,
    stripes: int,
    direction: str,
) -> StripeMap:
    """`read_code` of a Gray code with inverses. patterns, inverses: (bits, H, W)."""
    spec = ProjectorSpec.model_validate({"stripes": stripes, "direction": direction})
    for name, frames in (("patterns", patterns), ("inverses", inverses)):
        if len(frames) != spec.bits:
            raise DecodingFailed(
                f"{len(frames)} {name}, but the code has {spec.bits} bits",
                remedy="give one pattern and one inverse for each bit, or correct `stripes`",
            )
        if frames.shape[1:] != lit.shape:
            raise DecodingFailed(f"{name} of {frames.shape[1:]} px, lit frame of {lit.shape} px")
    return read_code(spec, lit, dark, np.concatenate([patterns, inverses]))
