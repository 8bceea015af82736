"""The light of every image of every stripe code, by the simulator's own formulas.

Only names, numbers and counts are taken from the codes' descriptions, never their `intensity`: a
mistake in that would be repeated here, and cancel out when the images are decoded.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import oaconvolve

from bodyscan.arrays import Array, Bytes, Floats, Mask
from bodyscan.errors import BadInput
from bodyscan.rig.frame_names import FrameNames
from bodyscan.rig.rig import Rig
from bodyscan.stripes.codes.gray import INVERSE, PATTERN, Binary, Gray
from bodyscan.stripes.codes.light_section import STRIPE, LightSection
from bodyscan.stripes.codes.phase_shift import PHASE, PhaseShift
from bodyscan.stripes.codes.stripe_index import INDEX, StripeIndex
from bodyscan.stripes.stripe_code import ImageKind, StripeCode, Wave

PAD = 4
"""Stripes by which a table of light extends beyond the sweep."""

FINE = 128
"""Entries of a table of light per stripe."""


def count_bits(stripes: int) -> int:
    """Count the patterns needed to distinguish the stripes."""
    return int(np.ceil(np.log2(stripes)))


def compute_gray_code_bits(stripes: int, first: int = 0) -> Mask:
    """Compute whether pattern k of a Gray code lights stripe i, (bits, stripes), 0 highest.

    first: the number of stripe 0.
    """
    index = np.arange(first, first + stripes)
    code = index ^ (index >> 1)
    positions = np.arange(count_bits(first + stripes))[::-1]
    return (code >> positions[:, None] & 1).astype(bool)


def find_table_entries(
    s: NDArray[np.floating], stripes: int, blur: NDArray[np.integer] | None = None
) -> NDArray[np.int32]:
    """Numbers of the entries of a light table for s (NaN: outside the sweep), in the row of its blur
    if there are several."""
    entries = (stripes + 2 * PAD) * FINE
    position = np.nan_to_num((s + PAD) * FINE, nan=0.0, posinf=0.0, neginf=0.0)
    index = np.clip(position, 0, entries - 1).astype(np.int32)
    return index if blur is None else (index + blur * entries).astype(np.int32)


def make_light_table(
    lit: NDArray[Any], blurs: Array, jitter: Array | None = None, parts: int = 1
) -> Floats:
    """Tabulate one frame's light, 0 to 1, against s: the lit stripes, (B, entries).

    lit: (S,), or (S * parts,) if light changes inside stripes.
    blurs: (B,) standard deviations in stripes.
    jitter: (S + 1,) displacement of each boundary, in stripes.
    """
    stripes = len(lit) // parts
    boundaries = np.arange(stripes + 1, dtype=float)
    if jitter is not None:
        boundaries = np.maximum.accumulate(boundaries + jitter)
    if parts > 1:
        within = np.arange(stripes * parts + 1) / parts
        boundaries = np.interp(within, np.arange(stripes + 1.0), boundaries)
    energy = np.concatenate([[0.0], np.cumsum(lit * np.diff(boundaries))])
    edges = np.arange((stripes + 2 * PAD) * FINE + 1) / FINE - PAD
    sharp = np.diff(np.interp(edges, boundaries, energy)) * FINE
    return _blur_light(sharp.astype(np.float32), tuple(blurs.tolist()))


def _blur_light(values: Floats, blurs: tuple[float, ...]) -> Floats:
    """Blur values (N,) by each blur, (B, N); block-wise Fourier transforms are ten times quicker."""
    if max(blurs) <= 0:
        return np.repeat(values[None], len(blurs), axis=0)
    padded = np.pad(values, PAD * FINE, mode="edge")
    return np.asarray(
        oaconvolve(padded[None], _sample_kernels(blurs), mode="valid", axes=1), np.float32
    )


@lru_cache(maxsize=8)
def _sample_kernels(blurs: tuple[float, ...]) -> Floats:
    """Sample Gaussians (B, k) of these sigmas in stripes, cut at four of them or at PAD."""
    position = np.arange(-PAD * FINE, PAD * FINE + 1) / FINE
    reached = np.minimum(4.0 * np.array(blurs), PAD)[:, None]
    sigma = np.maximum(blurs, 1e-3 / FINE)[:, None]
    bells = np.exp(-0.5 * (position / sigma) ** 2) * (
        np.abs(position) <= np.maximum(reached, 0.5 / FINE)
    )
    return np.asarray(bells / bells.sum(axis=1, keepdims=True), np.float32)


def refuse_unknown_code(code: StripeCode, pair: str) -> None:
    """Raise BadInput for a code that has no formulas here."""
    if type(code) not in (Gray, Binary, LightSection, PhaseShift, StripeIndex):
        raise BadInput(
            f"the simulator cannot project its stripe code, {code.code}",
            where=f"pair {pair}",
            remedy="the simulator has formulas of its own for each code, so that no mistake is made "
            "twice: add those of this code to bodyscan/simulation/patterns.py",
        )


def refuse_unknown_frames(rig: Rig) -> None:
    """Raise BadInput for kinds of images that are not rendered here."""
    crossed = next((p.name for p in rig.pairs if p.projector and p.projector.crossing), None)
    wrong = {
        "it projects stripes one way only": crossed is not None,
        "it takes a lit image, and looks for boards there": rig.frames.lit != rig.frames.board_image
        or rig.frames.lit is None,
        "it cannot tell what `*` in file names stands for": "*" in rig.files,
    }
    for what, refused in wrong.items():
        if refused:
            raise BadInput(
                f"the simulator cannot make such captures: {what}",
                where=f"rig {rig.name}",
                remedy="describe the rig for the simulator without that",
            )


def make_patterns(code: StripeCode, frames: FrameNames) -> dict[str, Array]:
    """Compute light (stripes * k,), 0 to 1, evenly over the sweep, by name of the image.

    For a stripe-index rig, what its instrument projects: Gray code (see `instrument`).
    """
    if isinstance(code, LightSection):
        return _name_images(frames, STRIPE, np.eye(code.stripes))
    if isinstance(code, PhaseShift):
        parts = 16  # values per stripe
        position = (np.arange(code.stripes * parts) + 0.5) / parts
        waves = np.concatenate([_compute_wave_images(wave, position) for wave in code.waves])
        phases = _name_images(frames, PHASE, waves)
        if not code.needs_gray:
            return phases
        halves = np.floor(2.0 * position / code.waves[0].period).astype(int)
        bits = compute_gray_code_bits(int(halves[-1]) + 1)[:, halves].astype(float)
        return _name_bit_images(frames, bits, code.inverses) | phases
    if isinstance(code, Binary):
        last = code.first_code + code.stripes
        shifts = np.arange(count_bits(last))[::-1]
        bits = (np.arange(code.first_code, last) >> shifts[:, None] & 1).astype(float)
        return _name_bit_images(frames, bits, code.inverses)
    inverses, first = (code.inverses, code.first_code) if isinstance(code, Gray) else (True, 0)
    return _name_bit_images(
        frames, compute_gray_code_bits(code.stripes, first).astype(float), inverses
    )


def _compute_wave_images(wave: Wave, position: Array) -> Array:
    """Compute images (steps, N), the wave shifted by a part of its period at each step."""
    step = wave.period / wave.steps * (1.0 if wave.shift == "forward" else -1.0)
    crest = wave.origin - wave.start * wave.period / (2.0 * np.pi)
    return np.stack(
        [
            np.cos(np.pi * (position - crest - k * step) / wave.period) ** 2
            for k in range(wave.steps)
        ]
    )


def _name_bit_images(frames: FrameNames, bits: Array, inverses: bool) -> dict[str, Array]:
    inverse = _name_images(frames, INVERSE, 1.0 - bits) if inverses else {}
    return _name_images(frames, PATTERN, bits) | inverse


def _name_images(frames: FrameNames, kind: ImageKind, images: Array) -> dict[str, Array]:
    return dict(zip(frames.kind_names(kind, len(images)), images, strict=True))


def simulate_instrument(
    images: dict[str, Bytes], code: StripeCode, frames: FrameNames
) -> dict[str, Bytes]:
    """Compute the lit and the stripe-index image from camera images of its Gray code.

    images: by the names of `patterns.projected_patterns`, with lit and a dark one named "".
    """
    lit_name = frames.lit or "lit"
    lit, dark = images[lit_name], images[""]
    coded = [name for name in images if name not in (lit_name, "")]
    bits = count_bits(code.stripes)
    words = sum(
        (images[pattern] > images[inverse]).astype(int) << (bits - 1 - bit)
        for bit, (pattern, inverse) in enumerate(zip(coded[:bits], coded[bits:], strict=True))
    )
    number = np.zeros(2**bits, np.uint8)
    number[(1 << np.arange(bits)[::-1]) @ compute_gray_code_bits(code.stripes)] = (
        np.arange(code.stripes) + 1
    )
    index = number[words]
    index[lit.astype(int) - dark < 12] = 0  # grey levels: too dark for a stripe
    index[lit == 255] = 255  # saturated
    (name,) = frames.kind_names(INDEX, 1)
    return {lit_name: lit, name: index}
