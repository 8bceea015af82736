"""The images that a rig's projectors show, as PNG files with a list of their order."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.errors import BadInput
from bodyscan.files.atomic import hold_folder, write_bytes, write_json
from bodyscan.rig.frame_names import FrameNames
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.stripes.stripe_code import StripeCode


def find_uneven_stripes(rig: Rig, width: int, height: int) -> tuple[str, ...]:
    """Note each kind of projector whose stripes cannot all have the same width.

    Their boundaries are up to half a projector pixel from those of even stripes: free planes absorb
    that, models that are smooth in s do not. Waves of light need no whole pixels.
    """
    kinds = {one for pair in rig.pairs if pair.projector for one in pair.projector.directions}
    counts = {
        (kind.stripes, height if kind.direction == "horizontal" else width)
        for kind in kinds
        if kind.has_edges
    }
    return tuple(
        f"{stripes} stripes cannot be equally wide on {across} px: choose a number that divides it"
        for stripes, across in sorted(counts)
        if across % stripes
    )


def write_patterns(rig: Rig, out: Path, width: int, height: int) -> tuple[Path, ...]:
    """Write a folder of images for each kind of projector in the rig, and last its list.

    width, height: of the projector's image, px.

    Returns the lists. Raises BadInput for a rig whose projectors show no images, and as
    `StripeCode.pattern_images`.
    """
    kinds: dict[StripeCode, list[Pair]] = {}
    for pair in rig.pairs:
        if pair.projector and pair.projector.is_projected:
            kinds.setdefault(pair.projector, []).append(pair)
    if not kinds:
        raise BadInput(
            "none of its projectors displays images",
            where=f"rig {rig.name}",
            remedy="an instrument with code: stripe-index projects stripes of its own"
            if any(pair.projector for pair in rig.pairs)
            else "give its pairs a `projector`: docs/formats.md shows how",
        )
    # Such as gray-640-horizontal, numbered if they would be equal.
    names: dict[StripeCode, str] = {}
    for kind in kinds:
        directions = "-".join(f"{one.stripes}-{one.direction}" for one in kind.directions)
        name = f"{kind.code}-{directions}"
        again = sum(taken.startswith(name) for taken in names.values())
        names[kind] = f"{name}-{again + 1}" if again else name
    # Make every kind before writing the first: if one does not fit, nothing is written.
    made = {kind: kind.pattern_images(width, height) for kind in kinds}
    return tuple(
        _write_kind(Path(out) / names[kind], rig.frames, kind, pairs, made[kind])
        for kind, pairs in kinds.items()
    )


def name_patterns(frames: FrameNames, kind: StripeCode, coded: Bytes) -> dict[str, Bytes]:
    """A projector's images (height, width) by frame, in the best order to show them: lit and dark if
    they are taken, then the code's.

    coded: from `StripeCode.pattern_images`.
    """
    blank, images = np.zeros(coded.shape[1:], np.uint8), dict[str, Bytes]()
    if frames.lit is not None:
        images[frames.lit] = blank + 255
    if frames.dark is not None and any(one.uses_dark for one in kind.directions):
        images[frames.dark] = blank
    of_code = dict(zip(frames.code_names(kind), coded, strict=True))
    return images | {name: of_code[name] for name in frames.shown_names(kind)}


def _write_kind(
    folder: Path, frames: FrameNames, kind: StripeCode, pairs: list[Pair], coded: Bytes
) -> Path:
    """Write a kind's images, and patterns.json with the best order to show them."""
    height, width = coded.shape[1:]
    images = name_patterns(frames, kind, coded)
    with hold_folder(folder):
        for name, image in images.items():
            write_bytes(folder / f"{name}.png", cv2.imencode(".png", image)[1].tobytes())
    content = {
        "version": 1,
        "code": {"code": kind.code, **kind.model_dump(mode="json", exclude_defaults=True)},
        "width": width,
        "height": height,
        "pairs": [pair.name for pair in pairs],
        "show": [{"file": f"{name}.png", "frame": name} for name in images],
    }
    write_json(folder / "patterns.json", content)
    return folder / "patterns.json"
