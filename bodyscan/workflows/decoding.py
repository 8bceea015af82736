"""From the files of one stripe sequence to its stripe map."""

from __future__ import annotations

from bodyscan.captures.folder import ImageSequence
from bodyscan.captures.images import read_sequence
from bodyscan.errors import DecodingFailed
from bodyscan.rig.pair import Pair
from bodyscan.stripes.codes import read_code
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.wanted_stripes import WantedStripes


def decode_sequence(
    sequence: ImageSequence, pair: Pair, *, wanted: WantedStripes | None = None, workers: int = 1
) -> StripeMap:
    """Read and decode what `pair` took in one shot; wanted: see `read_code`.

    Raises ImageError for bad files, DecodingFailed (naming pair and shot) for frames that do not
    add up or a pair without projector.
    """
    where = f"pair {sequence.pair}, shot {sequence.shot}"
    if pair.projector is None:
        raise DecodingFailed("this pair has no projector", where=where)
    images = read_sequence(sequence, pair.camera, workers=workers)
    frames = (images.lit, images.dark, images.coded)
    return read_code(pair.projector, *frames, wanted=wanted, where=where)
