from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from ring import in_sigmas, nominal, ring_of_cameras, ring_rig, ring_views, rms_mm

from bodyscan.errors import RigDisconnected
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.rig_solve import solve_rig
from bodyscan.rig.board import Board
from bodyscan.rig.gauge import RigFrame

PLAIN = Board(name="plain", columns=9, rows=7, square_mm=70)


def test_twelve_cameras_are_placed() -> None:
    placings, cameras = ring_of_cameras()
    views, _ = ring_views(placings, cameras)
    outcome = solve_rig(ring_rig(placings), views, cameras)
    placed = outcome.value
    # Sigmas of the centres that the solve reports are 0.05 to 0.1 mm here.
    assert rms_mm(placed, placings) < 0.25
    assert not outcome.notes


@pytest.mark.slow
@pytest.mark.parametrize("aside_px", [0.0, 0.1])
def test_sigmas_of_positions_are_honest(aside_px: float) -> None:
    """aside_px: sigma of an error that all corners of a view share; 48 tell little more than one."""
    rng = np.random.default_rng(8)
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    normalized = []
    for seed in range(6):
        views, _ = ring_views(placings, cameras, shots=20, seed=seed)
        views = [replace(v, pixels=v.pixels + rng.normal(0.0, aside_px, 2)) for v in views]
        placed = solve_rig(ring_rig(placings), views, cameras).value
        normalized += in_sigmas(placed, placings)
    # 6 x 5 x 3 draws, correlated within a seed (6 x 6 independent ones at worst): 1 +- 0.12.
    assert 0.75 < np.sqrt(np.mean(np.square(normalized))) < 1.3


def test_a_camera_alone_is_solved_like_one_of_many() -> None:
    placings, cameras = ring_of_cameras(poles=1, heights=(900,))
    views, _ = ring_views(placings, cameras, shots=30)
    (name, camera), *_ = cameras.items()
    longer = replace(camera, alpha=1.001 * camera.alpha)
    found = solve_rig(ring_rig(placings), views, {name: longer}).value
    sigma = np.sqrt(np.diag(found.camera_covariances[name]))
    assert abs(found.cameras[name].alpha - camera.alpha) < 4.0 * sigma[0]
    assert sigma[0] < 0.2e-3 * camera.alpha, "the start was off by more than five"


@pytest.mark.parametrize(("columns", "faces"), [(9, 1), (9, 2), (10, 2)])
def test_plain_boards_numbered_from_either_end_are_resolved(
    columns: int, faces: Literal[1, 2]
) -> None:
    thickness = 6 * (faces - 1)
    board = PLAIN.model_copy(update={"columns": columns, "faces": faces, "thickness_mm": thickness})
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    # A one-faced board is seen by two poles at once in few of so many shots.
    views, _ = ring_views(placings, cameras, shots=160 if faces == 1 else 50, board=board)
    placed = solve_rig(ring_rig(placings, board), views, cameras).value
    # One wrong turn among the tree's edges would show as metres.
    assert rms_mm(placed, placings) < 0.5


def test_an_ambiguous_board_seen_once_is_not_guessed() -> None:
    placings, cameras = ring_of_cameras(poles=1, heights=(900, 1100))
    views, _ = ring_views(placings, cameras, shots=60, board=PLAIN)
    shots = {v.shot for v in views if v.pair == "p1-1"} & {
        v.shot for v in views if v.pair == "p1-2"
    }
    views = [v for v in views if v.shot == min(shots)]
    with pytest.raises(RigDisconnected, match=min(shots)):
        solve_rig(ring_rig(placings, PLAIN), views, cameras)


def test_shots_numbered_one_further_on_in_one_camera_leave_a_plain_board_open() -> None:
    placings, cameras = ring_of_cameras(poles=1, heights=(900, 1100))
    views, _ = ring_views(placings, cameras, shots=60, board=PLAIN)
    seen = [{view.shot for view in views if view.pair == name} for name in placings]
    shots = sorted(seen[0] & seen[1])[:6]
    names = dict(zip(shots, [*shots[1:], *shots[:1]], strict=True))
    views = [
        replace(view, shot=names[view.shot]) if view.pair == "p1-1" else view
        for view in views
        if view.shot in shots
    ]
    with pytest.raises(RigDisconnected, match="shots named differently"):
        solve_rig(ring_rig(placings, PLAIN), views, cameras)


def test_a_corner_seen_only_once_does_no_harm() -> None:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    views, _ = ring_views(placings, cameras, shots=20)
    rare = views[0].points[0]
    thinned = [views[0]]
    for view in views[1:]:
        kept = np.any(view.points != rare, axis=1)
        thinned.append(replace(view, points=view.points[kept], pixels=view.pixels[kept]))
    placed = solve_rig(ring_rig(placings), thinned, cameras).value
    assert rms_mm(placed, placings) < 0.5


def test_a_plain_board_fixes_the_frame_the_way_round_that_the_rig_is_meant() -> None:
    board = PLAIN.model_copy(update={"faces": 2, "thickness_mm": 6})
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    views, truth = ring_views(placings, cameras, shots=30, board=board)
    shot = max(sorted({v.shot for v in views}), key=lambda s: sum(v.shot == s for v in views))
    fixed = truth[shot, board.name]
    frame = RigFrame(
        shot=shot,
        board=board.name,
        origin_mm=tuple(fixed.translation),
        x_axis=tuple(fixed.rotation[:, 0]),
        y_axis=tuple(fixed.rotation[:, 1]),
    )
    aside = RigidTransform.from_translation([12.0, -9.0, 15.0])
    pairs = tuple(
        pair.model_copy(update={"nominal": nominal(aside @ placings[pair.name])})
        for pair in ring_rig(placings).pairs
    )
    rig = ring_rig(placings, board, rig_frame=frame, pairs=pairs)
    placed = solve_rig(rig, views, cameras).value
    # Turned or the other face up it would be metres; one board in a few views is good to 1e-4 rad.
    assert rms_mm(placed, placings) < 0.5
    found = placed.rig_from_board[shot, board.name]
    assert (found.inverse() @ fixed).angle < 1e-6


@pytest.mark.slow
def test_skew_and_aspect_that_were_not_known_neither_harm_nor_stay_unsaid() -> None:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    rng = np.random.default_rng(11)
    given = {
        name: replace(c, beta=c.beta + rng.normal(0.0, 2.0), gamma=c.gamma + rng.normal(0.0, 0.8))
        for name, c in cameras.items()
    }
    errors, normalized = [], []
    for seed in range(4):
        views, _ = ring_views(placings, cameras, shots=20, seed=seed)
        placed = solve_rig(ring_rig(placings), views, given).value
        errors.append(rms_mm(placed, placings))
        normalized += in_sigmas(placed, placings)
    # With the true ones held, 0.13 mm; left as given, 1 mm.
    assert np.sqrt(np.mean(np.square(errors))) < 0.3
    # 4 x 6 independent draws at worst: 1 +- 0.15.
    assert 0.6 < np.sqrt(np.mean(np.square(normalized))) < 1.45
