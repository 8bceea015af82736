"""An instrument that outputs one image of stripe numbers
(the chapter's 4.1) instead of what it saw."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.gray import bit_count, code_bits
from bodyscan.stripes.codes.stripe_index import INDEX
from bodyscan.stripes.stripe_code import StripeCode

_LEAST_LIGHT = 12
_NONE, _TOO_BRIGHT = 0, 255


def instrument_images(
    images: dict[str, Bytes], code: StripeCode, frames: FrameNames
) -> dict[str, Bytes]:
    """The lit image and the stripe-index image, from what its camera saw of its Gray code.

    images: by the names of `patterns.projected_patterns`, with lit and a dark one named "".
    """
    shown = frames.lit or "lit"
    lit, dark = images[shown], images[""]
    seen = [name for name in images if name not in (shown, "")]
    bits = bit_count(code.stripes)
    words = sum(
        (images[pattern] > images[inverse]).astype(int) << (bits - 1 - bit)
        for bit, (pattern, inverse) in enumerate(zip(seen[:bits], seen[bits:], strict=True))
    )
    number = np.zeros(2**bits, np.uint8)
    number[(1 << np.arange(bits)[::-1]) @ code_bits(code.stripes)] = np.arange(code.stripes) + 1
    index = number[words]
    index[lit.astype(int) - dark < _LEAST_LIGHT] = _NONE
    index[lit == _TOO_BRIGHT] = _TOO_BRIGHT
    (name,) = frames.of_kind(INDEX, 1)
    return {shown: lit, name: index}
