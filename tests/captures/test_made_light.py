"""Real captures without their lit and dark images: boards and stripes are found as with them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from real_captures import real_rig_file

from bodyscan.arrays import Array
from bodyscan.boards.detection import find_boards
from bodyscan.captures.folder import open_captures
from bodyscan.captures.images import read_board_image, read_sequence
from bodyscan.rig.rig import load_rig
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap


def seen(rig_file: Path) -> tuple[Array, StripeMap]:
    """Corners of the board, and stripes."""
    rig = load_rig(rig_file)
    (pair,) = rig.pairs
    assert pair.projector is not None
    (sequence,) = open_captures(rig, rig_file).sequences
    (view,) = find_boards(read_board_image(sequence, pair), rig.boards, pair="p", shot="s")
    images = read_sequence(sequence, pair.camera)
    return view.pixels, decode_stripes(pair.projector, images.lit, images.dark, images.coded)


def test_the_patterns_tell_what_lit_and_dark_images_do(captures: Path, tmp_path: Path) -> None:
    rig_file = real_rig_file("procam-board", captures, tmp_path, ["capture_0"])
    corners, stripes = seen(rig_file)
    rig = json.loads(rig_file.read_text("utf-8"))
    rig["frames"] |= {"lit": None, "dark": None}
    rig_file.write_text(json.dumps(rig), "utf-8")
    made_corners, made_stripes = seen(rig_file)
    # Corners are good to some hundredths of a pixel, boundaries too; 0.02 px and 0.002 were seen.
    assert np.linalg.norm(made_corners - corners, axis=1).mean() < 0.05
    both = np.isfinite(stripes.s) & np.isfinite(made_stripes.s)
    assert both.sum() > 0.98 * np.isfinite(stripes.s).sum()
    assert np.median(np.abs((made_stripes.s - stripes.s)[both])) < 0.005
