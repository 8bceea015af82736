"""From the files of one stripe sequence to its stripe map."""

from __future__ import annotations

from bodyscan.capture.codes import read_code
from bodyscan.capture.folder import Sequence
from bodyscan.capture.images import read_sequence
from bodyscan.capture.rig import Pair
from bodyscan.capture.views import StripeMap
from bodyscan.capture.wanted_stripes import WantedStripes
from bodyscan.errors import DecodingFailed


def decode_sequence(
    sequence: Sequence, pair: Pair, *, wanted: WantedStripes | None = None, workers: int = 1
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
