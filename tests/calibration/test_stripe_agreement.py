"""Boards that disagree on the light of a projector: one is left out, or the pair is refused."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from lit_boards import (
    BODY_POSES,
    CHAPTER_POSES,
    Lens,
    Pose,
    Scene,
    Uneven,
    body_scene,
    chapter_scene,
)

from bodyscan.calibration.boundary_points import boundary_points, concatenate
from bodyscan.calibration.pair import compute_board_offsets, find_odd_board
from bodyscan.calibration.sheet_selection import fit_light_sheets
from bodyscan.errors import PairFailed

MORE_POSES = (
    *BODY_POSES,
    ([10.0, 60.0, 1300.0], [0.25, -0.25, 0.3]),
    ([-20.0, -60.0, 1200.0], [-0.3, -0.2, -0.2]),
    ([0.0, 100.0, 1350.0], [0.3, 0.35, 0.0]),
)


def find_odd(
    scene: Scene, poses: Sequence[Pose], moved: Sequence[int] = (), degrees: float = 0.1
) -> tuple[int, float] | None:
    """The odd one of a scene's boards, if its projector is turned for those that are `moved`."""
    parts = []
    for number, pose in enumerate(poses):
        of = turned(scene, degrees) if number in moved else scene
        data = of.boundaries([of.looking_at(*pose)], seed=number)
        parts.append(replace(data, board=np.full_like(data.board, number)))
    return find_odd_board(concatenate(parts), scene.projector.stripes, scene.direction)


def turned(scene: Scene, degrees: float) -> Scene:
    projector = scene.projector
    assert isinstance(projector, Lens)
    moved = projector.projector_from_camera.retract(np.array([np.radians(degrees), 0, 0, 0, 0, 0]))
    return replace(scene, projector=replace(projector, projector_from_camera=moved))


UNEVEN = replace(chapter_scene(), projector=Uneven(chapter_scene().projector, 0.3))


@pytest.mark.parametrize(
    ("scene", "poses"),
    [
        (body_scene(0.0), MORE_POSES),
        (body_scene(-0.12, 0.05), MORE_POSES),
        (chapter_scene(smile=0.5), CHAPTER_POSES),
        (UNEVEN, CHAPTER_POSES),
    ],
    ids=["pinhole", "lens", "mirror", "uneven stripes"],
)
def test_boards_that_saw_one_light_agree(scene: Scene, poses: Sequence[Pose]) -> None:
    assert find_odd(scene, poses) is None


@pytest.mark.parametrize("odd", [0, 2, 6])
def test_a_board_that_saw_other_light_is_found(odd: int) -> None:
    found = find_odd(body_scene(-0.05), MORE_POSES, (odd,))
    assert found is not None
    assert found[0] == odd
    # A tenth of a degree at 1.3 m from 0.28 m beside the camera is 11 mm of depth on one of seven.
    assert 2.0 < found[1] < 6.0


@pytest.mark.parametrize("moved", [(3, 4, 5, 6), (2, 3, 4, 5, 6)])
@pytest.mark.parametrize("degrees", [0.05, 0.1])
def test_a_projector_that_moved_for_several_boards_is_refused(
    moved: tuple[int, ...], degrees: float
) -> None:
    with pytest.raises(PairFailed, match=r"of 7 boards disagree by \d\.\d mm.*the projector moved"):
        find_odd(body_scene(-0.05), MORE_POSES, moved, degrees)


def test_of_three_boards_none_is_blamed_and_of_two_nothing_is_known() -> None:
    with pytest.raises(PairFailed, match="of 3 boards disagree"):
        find_odd(body_scene(-0.05), MORE_POSES[:3], (2,), 1.0)
    assert find_odd(body_scene(-0.05), MORE_POSES[:2], (1,), 1.0) is None


def test_boards_that_carry_each_others_stripes_are_refused() -> None:
    scene, parts = body_scene(-0.05), []
    boards = [scene.looking_at(*pose) for pose in MORE_POSES]
    for number, of in enumerate((1, 0, 2, 3, 4, 5, 6)):
        index, pixels = scene.crossings(boards[of], 24)
        placed = scene.camera, boards[number], index, pixels, np.full(len(index), 0.05)
        parts.append(boundary_points(*placed, board=number, direction=scene.direction))
    with pytest.raises(PairFailed, match="images of several shots are mixed up"):
        find_odd_board(concatenate(parts), scene.projector.stripes, scene.direction)


def test_a_board_that_stands_elsewhere_is_measured_there() -> None:
    scene = body_scene(0.0)
    poses = [scene.looking_at(*pose) for pose in MORE_POSES]
    data = scene.boundaries(poses, corner_px=0.0)
    fit = fit_light_sheets(data, scene.projector.stripes, scene.direction)
    # By its corners, board 2 lies 0.5 mm nearer than it does.
    nearer = np.where(data.board[:, None] == 2, data.points * (1.0 - 0.5 / 1400.0), data.points)
    off = compute_board_offsets(replace(data, points=nearer), fit.sheets)
    assert 0.25 < off[2] < 0.55
    assert np.abs(np.delete(off, 2)).max() < 0.05
