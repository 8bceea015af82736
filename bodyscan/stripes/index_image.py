"""One image of stripe numbers: luminance 1 to 254 is the number, 0 and 255 mean none.

Luminance n is stripe n - 1 here, since stripes count from 0: s lies between n - 1 and n.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Greys, Mask
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.boundaries import Boundaries, continues_to_next
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.sequence_checks import check_illumination
from bodyscan.stripes.stripe_coordinates import interpolate_stripes
from bodyscan.stripes.stripe_map import StripeMap, stripe_map
from bodyscan.stripes.stripe_order import check_order
from bodyscan.stripes.usable_pixels import beside_jumps

SIGMA = 12.0**-0.5
"""Standard deviation of a place known to be within one pixel, or of s within one stripe."""

MAX_SHARE_BEYOND = 0.01
NONE = (0, 255)


def decode_index(lit: Greys, numbers: Greys, direction: str, stripes: int) -> StripeMap:
    """The stripe map.

    lit: (H, W).
    numbers: (1, H, W).

    A boundary is only known to lie between two pixels. Along a line of boundaries s is interpolated
    nevertheless: it is closer to the truth than the middle of the stripe, which is used for pixels
    that lie between no two boundaries. Raises DecodingFailed if neighbours are not in neighbouring
    stripes.
    """
    black = np.zeros_like(lit)
    images = ScanLines.along_lines(lit, black, numbers, None, direction)
    index = images.patterns[0]
    numbered = ~np.isin(index, NONE)
    check_illumination(numbered, np.zeros_like(index))
    codes = index.astype(np.int32) - 1
    beyond = np.mean(codes[numbered] >= stripes)
    if beyond > MAX_SHARE_BEYOND:
        raise DecodingFailed(
            f"{beyond:.0%} of the pixels have a stripe number above {stripes}",
            remedy="correct `stripes` in the rig file, or give the stripe-index image itself",
        )
    check_order(np.where(numbered, codes, 0), numbered, images.turned, 256)
    usable = numbered & (codes < stripes)
    usable &= ~beside_jumps(codes, usable)
    boundaries = _boundaries(codes, usable)
    s, sigma = interpolate_stripes(boundaries, codes, usable)
    alone = usable & np.isnan(s)
    s[alone] = codes[alone] + 0.5
    sigma[alone] = SIGMA
    return stripe_map(images, lit, s, sigma, boundaries, stripes)


def _boundaries(codes: NDArray[np.int32], usable: Mask) -> Boundaries:
    """Boundaries halfway between neighbours on a line whose numbers differ by one."""
    change = np.abs(np.diff(codes, axis=1)) == 1
    line, before = np.nonzero(change & usable[:, 1:] & usable[:, :-1])
    index = np.maximum(codes[line, before], codes[line, before + 1]).astype(np.int64)
    position = before.astype(np.float64) + 0.5
    return Boundaries(
        line=line,
        before=before,
        position=position,
        line_position=line.astype(np.float64),
        sigma_px=np.full(len(line), SIGMA),
        index=index,
        joined=continues_to_next(line, before, position, index, usable),
        blur2=0.0,
    )
