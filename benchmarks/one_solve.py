"""What the stripes could add to a rig's solve: the boards' errors, and what their stripes know of
them.

Needs the workspace that `three-pole` simulates (benchmarks/full_size.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from bodyscan.arrays import Array
from bodyscan.boards.view import ViewKey
from bodyscan.calibration.stripe_agreement import board_offsets
from bodyscan.calibration.striped_view import BoardBoundaries, boundaries_on_boards
from bodyscan.captures.folder import open_captures
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.rig_file import load_rig
from bodyscan.workflows.calibrate_rig import join_rig, striped
from bodyscan.workflows.decode import decode_on_boards
from bodyscan.workflows.evaluate import Truth, load_truth
from bodyscan.workflows.find_boards import find_all_boards
from bodyscan.workflows.rig_remarks import JoinedRig

PROJECT = Path(__file__).parents[1]
WORKSPACE = PROJECT / "bench" / "three-pole-12"


def report() -> str:
    """The section of docs/results.md."""
    rig = load_rig(WORKSPACE / "rig.yaml")
    captures, truth = open_captures(rig, WORKSPACE / "rig.yaml"), load_truth(WORKSPACE / "truth")
    boards = find_all_boards(rig, captures)
    joined = join_rig(rig, captures, boards)
    decoded = decode_on_boards(rig, captures, boards.value).value
    off, told = np.concatenate(list(_errors(joined, decoded, truth)), axis=1)
    share = (off @ told) / (told @ told)
    left = off - share * told
    return f"""## What stripes could add to the rig's solve (synthetic)

The boards of `three-pole-12` as the corners of all cameras place them, before each pair's camera:
how far off they are along their normals, and how far the pair's stripes measure them from there;
{len(off)} views, less each pair's mean.

| | mm RMS |
|---|---|
| boards off their true places | {rms(off):.4f} |
| what their stripes say of it | {rms(told):.4f} |
| boards, less the best multiple ({share:+.2f}) of what stripes say | {rms(left):.4f} |

Correlation of the two: {np.corrcoef(off, told)[0, 1]:+.2f}.
"""


def _errors(
    joined: JoinedRig, decoded: dict[ViewKey, BoardBoundaries], truth: Truth
) -> Iterator[Array]:
    """Errors (2, B) mm for each pair, less their means: boards against the truth, and by the
    stripes."""
    placed, rig, facts = joined.placed, joined.calibration.rig, truth.facts
    for name, pair in joined.calibration.pairs.items():
        true = RigidTransform.from_matrix(facts["pairs"][name]["rig_from_camera"]).inverse()
        shots, off = [], []
        for view in placed.views:
            if view.pair != name or view.key not in decoded:
                continue
            shot = striped(rig, placed, view, decoded[view.key])
            pose = shot.view.camera_from_board
            corners = np.array(facts["boards"][view.board]["corners_mm"]).reshape(-1, 3)
            own = corners[cKDTree(corners).query(view.points)[1]]
            there = true @ RigidTransform.from_matrix(facts["shots"][view.shot]["rig_from_board"])
            away = pose.rotation[:, 2] * np.sign(pose.rotation[2, 2])
            off.append(float(((pose.apply(view.points) - there.apply(own)) @ away).mean()))
            shots.append(shot)
        projector = rig.pair(name).projector
        assert projector is not None
        assert pair.sheets is not None
        points = boundaries_on_boards(name, pair.camera, projector, shots)
        both = np.array([off, board_offsets(points, pair.sheets)])
        yield both - both.mean(axis=1, keepdims=True)
