"""Head and arms as wholes of their own, on cells laid out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from bodyscan.arrays import Array
from bodyscan.motion.body_cells import BodyCells
from bodyscan.motion.body_parts import (
    LIMBS,
    PARTS,
    build_limb_fields,
    compute_limb_weights,
    find_leftward,
    name_parts,
)
from bodyscan.motion.breath import build_breath_fields, project_breath_on_normals
from bodyscan.motion.estimation import BreathOffset, EstimatedMotion
from bodyscan.motion.person_motion import (
    PartMotion,
    PersonMotion,
    measure_breath,
    measure_fullness,
    summarize_parts,
)


def person() -> BodyCells:
    """A post with a bar across at the shoulders, one cell every 30 mm, all facing x."""
    post = [[0.0, 0.0, z] for z in np.arange(15.0, 1700.0, 30.0)]
    bar = [[0.0, y, 1365.0] for y in np.arange(-840.0, 841.0, 30.0) if y]
    centres = np.array(post + bar)
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    graph = sparse.csr_array(np.where(apart < 31.0, apart, 0.0))
    landmarks = np.arange(len(centres))
    normals = np.tile([1.0, 0.0, 0.0], (len(centres), 1))
    bare = BodyCells(centres, normals, graph, landmarks, np.empty((0, 0)))
    return BodyCells(centres, normals, graph, landmarks, bare.distances(landmarks))


def test_each_turns_about_its_joint_and_nothing_else_goes_along() -> None:
    cells = person()
    fields = build_limb_fields(cells, 400.0)
    assert set(fields) == set(LIMBS)
    hand, neck = int(np.argmax(cells.centres[:, 1])), at(cells, 0.0, 1450.0)
    other, foot = int(np.argmin(cells.centres[:, 1])), int(np.argmin(cells.centres[:, 2]))
    np.testing.assert_allclose(fields["left arm"][[other, foot], :3], 0.0, atol=1e-3)
    # A turn about z carries a fingertip by the 675 mm of the arm / 400.
    left = fields["left arm"]
    assert left[hand, 0, 2] == pytest.approx(-675.0 / 400.0, abs=0.05)
    np.testing.assert_allclose(left[hand, 1:3, 2], 0.0, atol=1e-3)
    # The middle of a border stays nearly where it is: half of its cells' way there goes along.
    assert np.abs(fields["head"][neck, :3]).max() < 0.05


def test_what_the_body_does_not_show_moves_nothing() -> None:
    cells = person()
    legs = cells.centres * [1.0, 1.0, 0.0] + [0.0, 0.0, 100.0]
    legs[0, 2] = 1000.0
    low = BodyCells(legs, cells.normals, cells.graph, cells.landmarks, cells.landmark_distances)
    assert np.abs(build_limb_fields(low, 400.0)["left arm"][1:]).max() < 1.0 + 1e-9


def at(cells: BodyCells, y: float, z: float) -> int:
    return int(np.argmin(np.hypot(cells.centres[:, 1] - y, cells.centres[:, 2] - z)))


def named(cells: BodyCells, y: float, z: float) -> str:
    return PARTS[name_parts(cells)[at(cells, y, z)]]


def test_parts_are_told_by_height_and_by_how_far_they_are_through_the_body() -> None:
    """Stature 1.695 m: the neck at 1.458, the crotch at 0.797; from a fingertip 678 mm of arm."""
    cells = person()
    assert [named(cells, 0.0, z) for z in (1665.0, 1485.0, 1425.0, 825.0)] == [
        "head", "head", "trunk", "trunk",
    ]  # fmt: skip
    for side, name in ((1.0, "left arm"), (-1.0, "right arm")):
        assert [named(cells, side * y, 1365.0) for y in (840.0, 180.0, 150.0)] == [
            name, name, "trunk",
        ]  # fmt: skip
    split = cells.centres.copy()
    below = split[:, 2] < 800.0
    split[below, 1] = np.where(np.arange(below.sum()) % 2, 5.0, -5.0)
    legs = replace(cells, centres=split)
    assert [named(legs, *cell) for cell in ((5.0, 405.0), (-5.0, 375.0))] == [
        "left leg",
        "right leg",
    ]


def test_an_arm_too_short_to_be_one_is_trunk() -> None:
    cells = person()
    for reach, name in ((300.0, "left arm"), (60.0, "trunk")):
        # From the navel 360 mm up and so far out; to a fingertip it is 85 mm longer than straight.
        kept = (cells.centres[:, 1] <= reach) & (cells.centres[:, 1] > -50.0)
        graph = cells.graph[kept][:, kept]
        short = BodyCells(
            cells.centres[kept], cells.normals[kept], graph, np.arange(3), cells.landmark_distances
        )
        assert named(short, reach, 1365.0) == name


def test_an_elbow_that_sticks_out_is_no_fingertip() -> None:
    """Of eight strangers five had an arm that was taken for trunk, or half a chest for an arm."""
    cells = person()
    bent = cells.centres.copy()
    beyond = np.maximum(bent[:, 1] - 480.0, 0.0)
    bent -= np.outer(beyond, [0.0, 1.5, 0.85])
    arm = replace(cells, centres=bent)
    ends = (330.0, 1110.0), (480.0, 1365.0), (0.0, 1365.0)
    assert [named(arm, *end) for end in ends] == ["left arm", "left arm", "trunk"]


@pytest.mark.parametrize("degrees", [0.0, 50.0, 180.0, -120.0])
def test_toes_tell_which_side_is_left(degrees: float) -> None:
    cells = person()
    feet = np.array([[x, 0.0, 20.0] for x in np.arange(0.0, 121.0, 30.0)])
    # The other foot is out of sight.
    shin = np.array([[0.0, -200.0, z] for z in np.arange(100.0, 240.0, 10.0)])
    centres = np.vstack([cells.centres, feet, shin])
    turn = np.radians(degrees)
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    centres[:, :2] = centres[:, :2] @ spin.T
    standing = replace(cells, centres=centres)
    np.testing.assert_allclose(find_leftward(standing), spin @ [0.0, 1.0], atol=1e-9)


def test_who_shows_no_toes_faces_the_rigs_x() -> None:
    np.testing.assert_allclose(find_leftward(person()), [0.0, 1.0])
    cells = person()
    legless = cells.centres[:, 2] > 300.0
    np.testing.assert_allclose(
        find_leftward(replace(cells, centres=cells.centres[legless])), [0.0, 1.0]
    )


def test_breath_shows_on_the_trunk() -> None:
    """Pubic bone 0.864, navel 1.017, collarbones 1.339 m, and the neck."""
    cells = person()
    found = project_breath_on_normals(cells)
    assert found[at(cells, 0.0, 1125.0)] == pytest.approx(1.0)
    assert found[at(cells, 0.0, 1035.0)] == pytest.approx(1.0)
    half = found[at(cells, 0.0, 945.0)]
    t = (945.0 / 1695.0 - 0.51) / 0.09
    assert half == pytest.approx(t * t * (3.0 - 2.0 * t))
    t = (1395.0 / 1695.0 - 0.79) / 0.07
    assert found[at(cells, 0.0, 1395.0)] == pytest.approx(1.0 - t * t * (3.0 - 2.0 * t))
    assert not found[[at(cells, 0.0, z) for z in (1665.0, 855.0, 100.0)]].any()
    assert found[at(cells, 780.0, 1365.0)] == 0.0
    # Skin that faces up or down as much as forward goes out by less, whatever it is that moves.
    slanting = replace(cells, normals=np.tile([0.6, 0.0, -0.8], (len(cells.centres), 1)))
    assert project_breath_on_normals(slanting)[at(cells, 0.0, 1125.0)] == pytest.approx(0.6)


def deep(cells: BodyCells) -> BodyCells:
    """The same with a trunk 300 mm deep and 400 mm wide: cells by turns in front, behind, at the sides
    and in the middle."""
    centres = cells.centres.copy()
    trunk = (centres[:, 2] > 600.0) & (centres[:, 1] == 0.0)
    around = [[150.0, 0.0], [-150.0, 0.0], [0.0, 200.0], [0.0, -200.0], [0.0, 0.0]]
    centres[trunk, :2] = np.resize(np.array(around), (int(trunk.sum()), 2))
    return replace(cells, centres=centres)


def test_a_trunk_swells_away_from_its_back_and_its_middle() -> None:
    """Level, whichever way the skin faces; the middle half as far forward as the front."""
    cells = deep(person())
    slanting = replace(cells, normals=np.tile([0.6, 0.0, -0.8], (len(cells.centres), 1)))
    height = cells.centres[:, 2]
    full = (height > 1020.0) & (height < 1330.0) & (np.abs(cells.centres[:, 1]) < 250.0)
    x, y = cells.centres[full, :2].T
    for body in (cells, slanting):
        as_one = build_breath_fields(body)[full, :3, 0]
        np.testing.assert_allclose(as_one[:, 0], 0.5 + x / 300.0, atol=0.03)
        np.testing.assert_allclose(as_one[:, 1], 0.3 * y / 200.0, atol=0.02)
        np.testing.assert_allclose(build_breath_fields(body)[:, 2], 0.0, atol=1e-12)


def test_a_breath_moves_the_front_of_the_trunk_alike_over_a_palm() -> None:
    """Products of the fields sum to how alike two cells move, times how far each may: all as one, and
    a third of it chest against belly, and by 80 mm, in few fields."""
    cells = person()
    moves, apart = project_breath_on_normals(cells), cells.landmark_distances
    fields = build_breath_fields(cells)
    assert np.abs(fields[:, 2]).max() == 0.0, "level"
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    upper = np.clip((height - 0.60) / 0.08, 0.0, 1.0)
    side = 2.0 * upper**2 * (3.0 - 2.0 * upper) - 1.0
    alike = np.outer(side, side) + np.exp(-0.5 * (apart / 80.0) ** 2)
    likeness = np.outer(moves, moves) * (1.0 + 0.35**2 * alike)
    # Functions of less than a fiftieth of the largest are left out.
    assert np.abs(fields[:, 0] @ fields[:, 0].T - likeness).max() < 0.03
    forward = np.any(fields[:, 0] != 0.0, axis=0)
    assert forward.sum() <= 2 + np.ptp(cells.centres[moves > 0.0, 2]) / 60.0


def followed(
    cells: BodyCells, rise: Array, amounts: Array, sigma_mm: float = 0.5
) -> EstimatedMotion:
    """The trunk's cells displaced along their normals by `rise` times each pair's amount."""
    trunk = name_parts(cells) == PARTS.index("trunk")
    bends = {}
    for number, amount in enumerate(amounts):
        bends[f"p{number}"] = np.zeros((len(cells.centres), 12))
        bends[f"p{number}"][trunk, 0] = 2.0 + amount * rise
    count = len(cells.centres)
    return EstimatedMotion(
        cells,
        bends,
        np.zeros((len(amounts), count, 3)),
        np.ones((len(amounts), count), bool),
        np.full(count, sigma_mm),
        0.0,
    )


def test_a_breath_is_told_by_how_far_the_trunk_rose() -> None:
    cells = person()
    trunk = int(np.count_nonzero(name_parts(cells) == PARTS.index("trunk")))
    amounts = np.array([-3.0, 0.0, 1.0, 4.0])
    even = np.ones(trunk)
    assert measure_breath(followed(cells, even, amounts)) == pytest.approx(7.0)
    # Where it rose most, but for one in twenty.
    high = np.where(np.arange(trunk) < 1, 9.0, np.where(np.arange(trunk) < 8, 2.0, 1.0))
    assert measure_breath(followed(cells, high, amounts)) == pytest.approx(14.0)
    # By more than four sigmas.
    assert measure_breath(followed(cells, even, amounts, 1.7)) == pytest.approx(7.0)
    assert measure_breath(followed(cells, even, amounts, 1.8)) is None
    # Most of it outwards together: 80 % against 20 %, and 79 against 21, leave 0.6 and 0.58.
    for share, told in ((0.18, True), (0.22, False)):
        some = np.where(np.arange(trunk) < share * trunk, -1.0, 1.0)
        assert (measure_breath(followed(cells, some, amounts)) is not None) == told


def test_what_is_left_of_a_parts_motion_is_its_cells_root_mean_square() -> None:
    cells = person()
    body = followed(cells, np.ones(1), np.zeros(1))
    head = name_parts(cells) == PARTS.index("head")
    sigma = np.full(len(head), 0.2)
    sigma[head] = np.where(np.arange(head.sum()) % 2, 0.1, 0.7)  # 0.5 squared in the mean of both
    left = {part.name: part.left_mm for part in summarize_parts(replace(body, sigma_mm=sigma))}
    assert left["head"] == pytest.approx(0.5)
    assert left["trunk"] == pytest.approx(0.2)


def test_fullness_is_that_of_the_front_of_the_trunk() -> None:
    cells = person()
    body = followed(cells, np.ones(1), np.zeros(1))
    assert measure_fullness(body) is None
    field = np.zeros((len(cells.centres), 12))
    rises = project_breath_on_normals(cells) > 0.5
    field[rises, 0] = np.where(np.arange(rises.sum()) % 2, -1.0, -2.0)
    field[~rises, 0] = 50.0
    sigma = np.where(rises, 0.3, 9.0)
    told = measure_fullness(replace(body, breath=BreathOffset(field, sigma)))
    assert told == pytest.approx((1.5, 0.3), abs=0.05)


def test_over_a_border_what_moves_passes_into_what_does_not_as_a_bell_curve_sums() -> None:
    """An arm of 23 cells: 105 mm within it, 96 % of a cell are the arm's."""
    cells = person()
    arm = compute_limb_weights(cells)["left arm"]
    part = name_parts(cells) == PARTS.index("left arm")
    along = cells.centres[:, 1]
    border = along[part].min() - 15.0
    for away_mm, share in ((15.0, 0.599), (75.0, 0.894), (105.0, 0.960)):
        here = at(cells, border + away_mm, 1365.0)
        assert arm[here] == pytest.approx(share, abs=0.02)


def test_how_far_a_part_moved_is_what_all_but_a_twentieth_of_it_did_at_most() -> None:
    """Of each of its cells what any pair saw that did see it; and cells that one pair saw alone."""
    cells = person()
    body = followed(cells, np.ones(1), np.zeros(2))
    trunk = np.flatnonzero(name_parts(cells) == PARTS.index("trunk"))
    seen = np.zeros((2, len(cells.centres)), bool)
    moved = np.zeros((2, len(cells.centres), 3))
    third = len(trunk) // 3
    seen[0, trunk], seen[1, trunk[:third]] = True, True
    far = np.linspace(0.0, 5.0, len(trunk))
    moved[0, trunk] = 0.1 * far[:, None] * [0.6, 0.0, 0.8]
    moved[1, trunk] = far[:, None] * [0.0, 0.8, -0.6]  # all of the trunk, but two thirds are hidden
    (part,) = summarize_parts(replace(body, observed=seen, displacements=moved))
    assert part.name == "trunk"
    shown = np.where(np.arange(len(trunk)) < third, far, 0.1 * far)
    assert part.moved_mm == pytest.approx(np.percentile(shown, 95.0))
    assert part.seen_once == pytest.approx(1.0 - third / len(trunk))


def told_of(*left: tuple[str, float, float]) -> str:
    parts = tuple(PartMotion(name, moved, known, 0.0) for name, moved, known in left)
    return PersonMotion(parts, None, 900.0).summary


def test_who_needs_a_part_better_than_a_girth_of_two_millimetres_is_told_which() -> None:
    assert told_of() == ""
    untimed = PersonMotion((PartMotion("head", 2.0, 0.1, 0.0),), None, None)
    assert untimed.summary.startswith("`timing` is missing in captures.yaml")
    assert told_of(("trunk", 4.4, 0.3), ("head", 11.6, 0.1)) == (
        "moved 12 mm while being scanned; corrected to 0.22 mm"
    )
    assert told_of(("trunk", 4.4, 0.3), ("head", 2.0, 0.31), ("left arm", 2.0, 1.0)).endswith(
        "; repeat if you need the head (0.3 mm), the left arm (1.0 mm)"
    )


@pytest.mark.parametrize(("fuller_mm", "side"), [(1.24, "in front of"), (-1.24, "behind")])
def test_lines_say_which_way_a_breath_stood(fuller_mm: float, side: str) -> None:
    person = PersonMotion((PartMotion("head", 2.04, 0.1, 0.0),), 4.2, 900.0, fuller_mm, 0.36)
    assert person.lines == (
        "head: moved by 2.0 mm, corrected to 0.10 mm",
        "breath of 4.2 mm, corrected to one moment",
        f"chest and belly were 1.2 +- 0.4 mm {side} their position at mean breath: girths are given "
        "at mean breath",
    )
    assert (
        PersonMotion((), None, None, 0.0, 1.42).lines[-1].endswith("mean breath to +- 1.4 mm there")
    )
    assert PersonMotion((), None, None).lines == ("breath cannot be separated from other motion",)
