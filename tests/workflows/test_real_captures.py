"""Real images, and a person of an independent renderer (BODYSCAN_PEOPLE), read in place: where they are
missing, skipped; in CI, failed."""

from __future__ import annotations

import json
import os
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import yaml
from real_captures import real_rig_file
from required import missing
from small_workspace import PROJECT, run

from benchmarks.free_triangulation import (
    FreeTriangulation,
    RigWithoutShots,
    pooled,
    triangulate_shots,
    without_shots,
)
from benchmarks.held_out_boards import hold_out_boards
from benchmarks.independent_people import load_truth, measure_rms_without_hair
from bodyscan.arrays import Array
from bodyscan.boards.detection import find_boards
from bodyscan.boards.view import BoardView
from bodyscan.captures.folder import Captures, open_captures
from bodyscan.captures.images import read_board_image, read_sequence
from bodyscan.fusion.storage import load_scan
from bodyscan.geometry.uncertainty import point_covariance
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.workflows.calibrate_rig import calibrate_rig
from bodyscan.workflows.find_boards import find_all_boards


def opened(path: Path) -> tuple[Rig, Captures]:
    rig = load_rig(path)
    return rig, open_captures(rig, path)


def test_a_real_pair_is_calibrated(captures: Path, tmp_path: Path) -> None:
    calibration = calibrate_rig(*opened(real_rig_file("procam-board", captures, tmp_path)))
    pair = calibration.pairs["procam"]
    assert pair.quality.poses == 4
    assert pair.quality.corners_rms_px is not None
    # Sub-pixel corners of an 8-bit camera in focus; a wrong board order would be tens of px.
    assert pair.quality.corners_rms_px < 0.3
    # Horizontal stripes, which reach only part of the image: those that fall on boards.
    assert pair.quality.stripes_calibrated > 400


def test_held_out_boards_are_measured_best_by_the_chosen_model(
    captures: Path, tmp_path: Path
) -> None:
    rig, shots = opened(real_rig_file("procam-board", captures, tmp_path))
    results = hold_out_boards(rig, shots, "procam")
    mean = {
        model: np.mean([r.median_mm for r in results if r.model == model])
        for model in {r.model for r in results}
    }
    chosen = mean.pop("chosen by held-out boards")
    assert chosen <= min(mean.values()), mean
    # A throw-away attempt on five such poses had 2.2 for free planes and 5.6 to 7.9 for pinholes.
    assert chosen < 2.2
    assert mean["free planes"] < 3.5


@pytest.mark.parametrize("square_mm", [1.0, 1000.0])
def test_two_cameras_before_a_board_that_looks_the_same_turned(
    captures: Path, tmp_path: Path, square_mm: float
) -> None:
    path = real_rig_file("boardstereo", captures, tmp_path)
    rig = yaml.safe_load(path.read_text("utf-8"))
    rig["boards"][0]["square_mm"] = square_mm
    path.write_text(json.dumps(rig), "utf-8")
    calibration = calibrate_rig(*opened(path))
    assert not calibration.failed
    for name in "LR":
        pair = calibration.pairs[name]
        assert pair.quality.poses == 6, "a flipped board fits nowhere, and its view is taken out"
        assert pair.quality.corners_rms_px is not None
        # 0.14 and 0.21 px: OpenCV's stereo solve has 0.37. Each corner freed leaves less (0.12, 0.14)
        # but of boards left out more: a median of 0.58 px, where the stretch alone has 0.29.
        assert pair.quality.corners_rms_px < 0.23
    assert calibration.rig.boards[0].stretch == pytest.approx(0.990, abs=1e-3)  # by either camera
    # Any unit does for the squares: nothing that is decided depends on it.
    baseline = np.linalg.norm(calibration.rig_from_camera["R"].translation)
    assert baseline / square_mm == pytest.approx(4.48, rel=0.02)


# The board stood still in the first nine shots; in 12 to 16 it lies near the edges of some pictures.
# Left out together: those, and twice two of the others, one of them near the edges.
PLACES = ([f"{shot:02}" for shot in range(9)], ["10", "14"], ["12", "16"])
GOOD_LENSES = {"back": {"brown", "rational"}, "mid": {"brown", "rational"},
               "side": {"brown", "rational"}, "top": {"radial", "brown"}}  # fmt: skip
"""top's picture has no boards near its edges: its own boards cannot tell, and boards left out do not
care (0.0266 px with the one, 0.0270 with the other)."""


@pytest.fixture(scope="module")
def ring(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, list[BoardView]]:
    folder = tmp_path_factory.mktemp("ring")
    rig, shots = opened(real_rig_file("charuco-ring", captures, folder))
    return rig, find_all_boards(rig, shots).value


@pytest.fixture(scope="module")
def whole(ring: tuple[Rig, list[BoardView]]) -> RigWithoutShots:
    """The rig placed by all shots."""
    return without_shots(*ring, [])


@pytest.fixture(scope="module")
def left_out(ring: tuple[Rig, list[BoardView]]) -> dict[str, list[FreeTriangulation]]:
    """By the first shot left out: their boards, triangulated by the rig that the others place."""
    results = {}
    for some in PLACES:
        held = without_shots(*ring, some)
        results[some[0]] = triangulate_shots(
            held.left_out, held.placed.cameras, held.placed.rig_from_camera,
            held.placed.board_shapes,
        )  # fmt: skip
    return results


def test_no_good_view_is_lost_and_each_camera_gets_its_lens(whole: RigWithoutShots) -> None:
    # With k1 and k2 alone four views of shots 13 and 14 were off by up to 1.4 px, and thought wrong.
    assert len(whole.placed.views) == len(whole.used) == 68
    for name, camera in whole.placed.cameras.items():
        assert camera.lens.kind in GOOD_LENSES[name]
    # The corners are good to about 0.02 px; an exact adjustment with five coefficients reaches 0.06
    # on a flat board.
    assert max(whole.placed.rms_px.values()) < 0.06


def test_two_calibrations_from_different_shots_differ_as_they_say(
    ring: tuple[Rig, list[BoardView]],
) -> None:
    shots = sorted({view.shot for view in ring[1]})
    one, other = (without_shots(*ring, shots[start::2]).placed for start in (0, 1))
    ratios = []
    for a, b in combinations(sorted(one.rig_from_camera), 2):
        first, second = (
            (half.rig_from_camera[a].inverse() @ half.rig_from_camera[b]).translation
            for half in (one, other)
        )
        variances = [
            np.trace(point_covariance(half.covariance.relative(a, b), at.translation))
            for half in (one, other)
            for at in [half.rig_from_camera[b]]
        ]
        sigma = np.sqrt(sum(variances))
        ratios.append(np.linalg.norm(second - first) / sigma)
    # Either half has few places: 1 +- 0.3, twice over.
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_four_real_cameras_agree_on_boards_left_out(
    left_out: dict[str, list[FreeTriangulation]],
) -> None:
    rms_px, rms_mm, _ = pooled([one for place in PLACES for one in left_out[place[0]]])
    # Wanted: 0.09 px and 0.20 mm. Others, fitting all shots: 0.22 to 0.54 px and 0.23 to 0.49 mm.
    # Ours are left out, all of a place at a time; reached are 0.026 px and 0.211 mm against a flat
    # board, of which nearly all is the board's own bend and stretch.
    assert rms_px < 0.035
    assert rms_mm < 0.22


def test_the_real_board_is_bent_as_the_other_shots_say(
    left_out: dict[str, list[FreeTriangulation]],
) -> None:
    # Reached: 0.020 mm.
    *_, rms_shaped_mm = pooled([one for every in left_out.values() for one in every])
    assert rms_shaped_mm < 0.03


def test_wide_lenses_are_fitted_by_a_lens_for_them(captures: Path, tmp_path: Path) -> None:
    """Where the chapter's lens leaves 24 px and 3 px, and Brown's is no better."""
    wide = calibrate_rig(*opened(real_rig_file("wide-lens", captures, tmp_path))).pairs["cam"]
    # mrcal's rational lens with the board's bend leaves 0.77 px on these views, its splined one 0.67.
    assert wide.quality.corners_rms_px is not None
    assert wide.quality.corners_rms_px < 0.77
    assert wide.quality.poses == 93
    fisheye = calibrate_rig(*opened(real_rig_file("fisheye", captures, tmp_path))).pairs["cam"]
    assert fisheye.quality.corners_rms_px is not None
    assert fisheye.quality.corners_rms_px < 0.41  # OpenCV's fisheye
    assert fisheye.camera.lens.kind == "fisheye"
    assert fisheye.quality.poses == 21


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


@pytest.mark.slow
def test_the_cloud_of_the_woman_lies_on_the_true_body(tmp_path: Path) -> None:
    people = Path(os.environ.get("BODYSCAN_PEOPLE", PROJECT.parent / "shared" / "people"))
    if not (people / "woman").is_dir():
        missing(f"people not found at {people} (set BODYSCAN_PEOPLE)")
    woman, out = people / "woman", tmp_path / "model"
    run("scan", woman / "scan", "--calibration", woman / "calibration", "--out", out)
    points = load_scan(out).cloud.points
    some = np.random.default_rng(0).choice(len(points), min(len(points), 100_000), replace=False)
    # It is 0.17 mm.
    truth = load_truth(woman / "truth")
    assert measure_rms_without_hair(points[some].astype(float), truth) < 0.20
