"""The light of every image of every code, for the simulator alone: its own formulas.

Only names, numbers and counts are taken from the codes' descriptions, never their `intensity`: a
mistake in that would be repeated here, and cancel out when the images are decoded.
"""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import BadInput
from bodyscan.rig.frame_names import FrameNames
from bodyscan.rig.rig import Rig
from bodyscan.simulation.gray import bit_count, code_bits
from bodyscan.stripes.codes.gray import INVERSE, PATTERN, Binary, Gray
from bodyscan.stripes.codes.light_section import STRIPE, LightSection
from bodyscan.stripes.codes.phase_shift import PHASE, PhaseShift
from bodyscan.stripes.codes.stripe_index import StripeIndex
from bodyscan.stripes.stripe_code import ImageKind, StripeCode
from bodyscan.stripes.wave import Wave

PARTS = 16
"""Values of light per stripe, if light changes inside stripes."""

KNOWN = (Gray, Binary, LightSection, PhaseShift, StripeIndex)


def refuse_unknown_code(code: StripeCode, pair: str) -> None:
    """Raises BadInput for a code that has no formulas here."""
    if type(code) not in KNOWN:
        raise BadInput(
            f"its code {code.code} is none that the simulator knows how to project",
            where=f"pair {pair}",
            remedy="the simulator has formulas of its own for each code, so that no mistake is made "
            "twice: add those of this code to bodyscan/simulation/patterns.py",
        )


def refuse_unknown_frames(rig: Rig) -> None:
    """Raises BadInput for kinds of images that are not rendered here."""
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


def projected_patterns(code: StripeCode, frames: FrameNames) -> dict[str, Array]:
    """Light (stripes * k,), 0 to 1, at evenly spaced places of the sweep, by name of the image.

    For a stripe-index rig, what its instrument projects: Gray code (see `instrument`).
    """
    if isinstance(code, LightSection):
        return _named(frames, STRIPE, np.eye(code.stripes))
    if isinstance(code, PhaseShift):
        place = (np.arange(code.stripes * PARTS) + 0.5) / PARTS
        waves = np.concatenate([_wave_images(wave, place) for wave in code.waves])
        phases = _named(frames, PHASE, waves)
        if not code.needs_gray:
            return phases
        halves = np.floor(2.0 * place / code.waves[0].period).astype(int)
        bits = code_bits(int(halves[-1]) + 1)[:, halves].astype(float)
        return _bit_images(frames, bits, code.inverses) | phases
    if isinstance(code, Binary):
        last = code.first_code + code.stripes
        shifts = np.arange(bit_count(last))[::-1]
        bits = (np.arange(code.first_code, last) >> shifts[:, None] & 1).astype(float)
        return _bit_images(frames, bits, code.inverses)
    inverses, first = (code.inverses, code.first_code) if isinstance(code, Gray) else (True, 0)
    return _bit_images(frames, code_bits(code.stripes, first).astype(float), inverses)


def _wave_images(wave: Wave, place: Array) -> Array:
    """Images (steps, N): at each step the wave is shifted by
    a part of its period, forward or back."""
    step = wave.period / wave.steps * (1.0 if wave.shift == "forward" else -1.0)
    crest = wave.origin - wave.start * wave.period / (2.0 * np.pi)
    return np.stack(
        [np.cos(np.pi * (place - crest - k * step) / wave.period) ** 2 for k in range(wave.steps)]
    )


def _bit_images(frames: FrameNames, bits: Array, inverses: bool) -> dict[str, Array]:
    inverse = _named(frames, INVERSE, 1.0 - bits) if inverses else {}
    return _named(frames, PATTERN, bits) | inverse


def _named(frames: FrameNames, kind: ImageKind, images: Array) -> dict[str, Array]:
    return dict(zip(frames.of_kind(kind, len(images)), images, strict=True))
