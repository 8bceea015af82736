"""A projector that moves between the shots of a calibration is noticed, and its shots named."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from lit_boards import (
    BODY_POSES,
    CHAPTER_POSES,
    Lens,
    Mirror,
    Pose,
    Scene,
    Uneven,
    body_scene,
    chapter_scene,
)

from bodyscan.calibration.boundary_points import BoundaryPoints, boundary_points, concatenate
from bodyscan.calibration.light_sheets import fit_light_sheets
from bodyscan.calibration.pair import (
    ProjectorMotion,
    board_offsets,
    find_projector_motion,
)
from bodyscan.errors import PairFailed

MORE_POSES = (
    *BODY_POSES,
    ([10.0, 60.0, 1300.0], [0.25, -0.25, 0.3]),
    ([-20.0, -60.0, 1200.0], [-0.3, -0.2, -0.2]),
    ([0.0, 100.0, 1350.0], [0.3, 0.35, 0.0]),
)


def find_motion(
    scene: Scene, poses: Sequence[Pose], moved: Scene | None = None, shots: Sequence[int] = ()
) -> ProjectorMotion | None:
    """Boards of a scene; of the `shots`, as they are once its projector has moved."""
    parts = []
    for number, pose in enumerate(poses):
        of = moved if moved is not None and number in shots else scene
        data = of.boundaries([of.looking_at(*pose)], seed=number)
        parts.append(replace(data, board=np.full_like(data.board, number)))
    return find_projector_motion(concatenate(parts), scene.projector.stripes, scene.direction)


def pushed(scene: Scene, push: tuple[float, float, float]) -> Scene:
    projector = scene.projector
    assert isinstance(projector, Mirror)
    centre = projector.centre + np.array(push)
    return replace(scene, projector=replace(projector, centre=centre))


def turned(scene: Scene, degrees: float) -> Scene:
    projector = scene.projector
    assert isinstance(projector, Lens)
    moved = projector.projector_from_camera.retract(np.array([np.radians(degrees), 0, 0, 0, 0, 0]))
    return replace(scene, projector=replace(projector, projector_from_camera=moved))


@pytest.mark.parametrize("scene", [body_scene(0.0), body_scene(-0.12, 0.05)])
def test_a_projector_that_stays_is_not_suspected(scene: Scene) -> None:
    assert find_motion(scene, MORE_POSES) is None


def test_a_mirror_that_stays_is_not_suspected() -> None:
    assert find_motion(chapter_scene(smile=0.5), CHAPTER_POSES) is None


def test_uneven_stripes_are_no_move() -> None:
    scene = chapter_scene()
    uneven = replace(scene, projector=Uneven(scene.projector, 0.3))
    assert find_motion(uneven, CHAPTER_POSES) is None


@pytest.mark.parametrize(
    ("shots", "others", "moved"),
    [
        ((3, 4, 5, 6), [3, 4, 5, 6], True),
        # Two before: the projector stands where the others saw it.
        ((2, 3, 4, 5, 6), [0, 1], False),
        # Shots of their own.
        ((0,), [0], False),
        ((2,), [2], False),
        ((6,), [6], False),
    ],
)
def test_shots_are_split_in_the_simplest_way_that_explains_them(
    shots: tuple[int, ...], others: list[int], moved: bool
) -> None:
    scene = body_scene(-0.05)
    found = find_motion(scene, MORE_POSES, turned(scene, 0.1), shots)
    assert found is not None
    assert (found.others.tolist(), found.moved) == (others, moved)
    assert sorted([*found.kept.tolist(), *others]) == list(range(7))
    assert found.joint_px > 3.0 * found.separate_px


def mixed_up(scene: Scene, poses: Sequence[Pose], *exchanged: tuple[int, int]) -> BoundaryPoints:
    """Boards of which some carry each other's stripes: their images were exchanged."""
    boards = [scene.looking_at(*pose) for pose in poses]
    of = list(range(len(boards)))
    for one, other in exchanged:
        of[one], of[other] = other, one
    parts = []
    for number, board in enumerate(boards):
        index, pixels = scene.crossings(boards[of[number]], 24)
        sigma = np.full(len(index), 0.05)
        placed = (scene.camera, board, index, pixels, sigma)
        parts.append(boundary_points(*placed, board=number, direction=scene.direction))
    return concatenate(parts)


@pytest.mark.parametrize("exchanged", [(0, 1), (2, 5)])
def test_two_shots_whose_images_were_exchanged_are_left_out(exchanged: tuple[int, int]) -> None:
    scene = body_scene(-0.05)
    data = mixed_up(scene, MORE_POSES, exchanged)
    found = find_projector_motion(data, scene.projector.stripes, scene.direction)
    assert found is not None
    assert not found.moved
    np.testing.assert_array_equal(found.others, exchanged)


def test_stripes_of_which_most_are_mixed_up_are_refused() -> None:
    scene = body_scene(-0.05)
    data = mixed_up(scene, MORE_POSES, (0, 2), (1, 4), (3, 6))
    with pytest.raises(PairFailed, match="no projector explains the stripes"):
        find_projector_motion(data, scene.projector.stripes, scene.direction)


def test_of_three_poses_something_is_noticed() -> None:
    scene = chapter_scene()
    found = find_motion(scene, CHAPTER_POSES, pushed(scene, (0.0, 0.0, 3.0)), shots=(2,))
    assert found is not None


def test_two_boards_say_nothing() -> None:
    scene = chapter_scene()
    assert find_motion(scene, CHAPTER_POSES[:2], pushed(scene, (3.0, 0.0, 0.0)), (1,)) is None


def test_a_board_that_stands_elsewhere_is_measured_there() -> None:
    scene = body_scene(0.0)
    poses = [scene.looking_at(*pose) for pose in MORE_POSES]
    data = scene.boundaries(poses, corner_px=0.0)
    fit = fit_light_sheets(data, scene.projector.stripes, scene.direction)
    # By its corners, board 2 lies 0.5 mm nearer than it does.
    nearer = np.where(data.board[:, None] == 2, data.points * (1.0 - 0.5 / 1400.0), data.points)
    off = board_offsets(replace(data, points=nearer), fit.sheets)
    assert 0.25 < off[2] < 0.55
    assert np.abs(np.delete(off, 2)).max() < 0.05
