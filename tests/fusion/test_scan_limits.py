"""Every limit of the verdict from both sides, a fifth away or less."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_scan import MadeScan, egg, make_scan
from verdict_given import verdict_given

from bodyscan.alignment.body_parts import PartMotion, PersonMotion
from bodyscan.alignment.icp import Alignment
from bodyscan.alignment.pole_steps import StepSearch
from bodyscan.alignment.sway_prior import centre_sigmas
from bodyscan.arrays import Array
from bodyscan.fusion import scan_verdict
from bodyscan.fusion.contradictions import Contradictions
from bodyscan.fusion.crown import Crown
from bodyscan.fusion.surface_check import SurfaceCheck
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.rig.rig import Volume
from bodyscan.settings import UseLimits

TALL_MM = 1700.0
BODY = (300.0, 300.0)
"""A trunk: 90,000 mm2."""
Column = tuple[tuple[float, float], tuple[float, float], float, float]
"""Middle and sides in the plane, lowest and highest mm."""


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> MadeScan:
    return make_scan(tmp_path_factory.mktemp("scan"))


def told(cloud: BodyCloud, mesh: BodyMesh | None = None, **given: Any) -> tuple[str, str]:
    """Grade, and the reasons as one text."""
    verdict = verdict_given(cloud, mesh, **given)
    return verdict.grade, " | ".join(verdict.reasons)


def cloud_of(points: Array) -> BodyCloud:
    count = len(points)
    ones = np.ones(count, np.float32)
    return BodyCloud(
        points,
        np.tile(np.array([1.0, 0.0, 0.0], np.float32), (count, 1)),
        ones,
        np.zeros((count, 3), np.uint8),
        ones.astype(np.uint8),
    )


def scattered(columns: Sequence[Column], counts: Sequence[int]) -> BodyCloud:
    """Points all through some columns."""
    rng = np.random.default_rng(0)
    parts = [
        rng.uniform([x - a / 2, y - b / 2, low], [x + a / 2, y + b / 2, high], (count, 3))
        for ((x, y), (a, b), low, high), count in zip(columns, counts, strict=True)
    ]
    return cloud_of(np.concatenate(parts))


def boxes(columns: Sequence[Column]) -> BodyMesh:
    """A closed box for each column."""
    corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in sides for f in ((a, b, c), (a, c, d))], np.int64)
    vertices = [
        corner * [a, b, high - low] + [x - a / 2, y - b / 2, low]
        for (x, y), (a, b), low, high in columns
    ]
    all_faces = np.concatenate([faces + 8 * k for k in range(len(vertices))])
    every = np.concatenate(vertices)
    return BodyMesh(
        every,
        all_faces,
        np.zeros((len(every), 3), np.float32),
        np.zeros((len(every), 3), np.uint8),
        np.ones(len(every), np.float32),
        np.zeros(len(all_faces), bool),
    )


@pytest.mark.parametrize(
    ("left_mm", "grade"), [(0.6, "good"), (0.67, "usable"), (1.85, "usable"), (2.0, "repeat")]
)
def test_what_following_a_person_leaves_counts_by_the_girth_it_costs(
    scan: MadeScan, left_mm: float, grade: str
) -> None:
    """4 and 12 mm over 2 pi."""
    person = PersonMotion((PartMotion("trunk", 9.0, left_mm, 0.1),), None, None)
    assert told(scan.cloud, person=person)[0] == grade


def test_the_operator_says_how_much_motion_is_good_enough(scan: MadeScan) -> None:
    person = PersonMotion((PartMotion("trunk", 9.0, 1.2, 0.1),), None, None)
    wide = UseLimits(good_girth_mm=4.0, usable_girth_mm=8.0)
    moved = Alignment({}, {"p1": 6.0}, {}, ())
    assert told(scan.cloud, person=person, use=wide)[0] == "good"
    assert told(scan.cloud, alignment=moved, use=wide)[0] == "good"
    assert told(scan.cloud, alignment=moved)[0] == "usable"


@pytest.mark.parametrize(("boards_mm", "grade"), [(1.2, "usable"), (1.4, "good")])
def test_nobody_moved_where_the_boards_leave_a_pair_open_by_as_much(
    scan: MadeScan, boards_mm: float, grade: str
) -> None:
    """5 mm are 3.9 standard deviations of 1.3: 3 of them leave 3.2 mm, the limit."""
    moved = Alignment({}, {"p1": 5.0, "p2": 0.0}, {}, ())
    assert told(scan.cloud, alignment=moved, boards_mm={"p1": boards_mm})[0] == grade


@pytest.mark.parametrize(("boards_mm", "grade"), [(0.3, "usable"), (0.7, "good")])
def test_pairs_stand_off_by_more_than_the_boards_leave_open(
    scan: MadeScan, boards_mm: float, grade: str
) -> None:
    """0.5 mm along each axis, of which boards explain 0.17 or 0.40."""
    search = StepSearch(None, 1.0, 0.1, 0.5)
    boards = dict.fromkeys(("p1", "p2", "p3"), boards_mm)
    assert told(scan.cloud, search=search, boards_mm=boards)[0] == grade


def test_the_boards_put_the_body_off_by_places_and_by_turns() -> None:
    """A milliradian at the body's centre, 900 mm up, is 0.9 mm along x."""
    matrix = np.diag([0.0, 1e-6, 0.0, 0.0, 0.0, 0.16])
    (sigma,) = centre_sigmas(PoseCovariance(("p1",), matrix)).values()
    assert sigma == pytest.approx(np.hypot(0.9, 0.4))


@pytest.mark.parametrize(
    ("by_noise", "grade"), [(0.0, "repeat"), (0.015, "usable"), (0.026, "good")]
)
def test_what_noise_speaks_against_is_no_contradiction(
    scan: MadeScan, by_noise: float, grade: str
) -> None:
    """Three of a hundred, of 1000 words."""
    found = Contradictions(
        ("a", "b"), np.array([[0, 1000], [1000, 0]]), np.array([[0, 30], [30, 0]]), by_noise
    )
    assert told(scan.cloud, contradictions=found)[0] == grade


@pytest.mark.parametrize(
    ("filled", "grade"), [(0.11, "good"), (0.13, "usable"), (0.49, "usable"), (0.51, "repeat")]
)
def test_how_much_may_be_filled(scan: MadeScan, filled: float, grade: str) -> None:
    """The same share at every height, so that none has next to nothing."""
    height = np.repeat(np.arange(0.0, TALL_MM, 50.0) + 25.0, 100)
    gone = np.tile(np.arange(100) < 100 * filled, len(height) // 100)
    check = SurfaceCheck(height, np.ones(len(height)), gone, {}, {})
    assert told(scan.cloud, surface=check)[0] == grade


@pytest.mark.parametrize(("gone", "said"), [(0.45, False), (0.55, True)])
@pytest.mark.parametrize("band", [1, 12])
def test_a_height_at_which_next_to_nothing_was_measured(
    scan: MadeScan, gone: float, said: bool, band: int
) -> None:
    height = np.repeat(np.arange(0.0, TALL_MM, 50.0) + 25.0, 100)
    own = np.tile(np.arange(100) < 100 * gone, len(height) // 100) & (height // 50.0 == band)
    check = SurfaceCheck(height, np.ones(len(height)), own, {}, {})
    words = f"next to nothing was measured from {50 * band} to {50 * band + 50} mm"
    assert (words in told(scan.cloud, surface=check)[1]) == said


@pytest.mark.parametrize(
    ("share", "white", "words"),
    [
        (0.62, 0.04, ""),
        (0.58, 0.04, "pair p1 measured 58% of the skin"),
        (0.58, 0.06, "pair p1 is overexposed: 6%"),
        (0.62, 0.06, "pair p1 is overexposed: 6%"),
    ],
)
def test_what_a_pair_gave(scan: MadeScan, share: float, white: float, words: str) -> None:
    check = SurfaceCheck(
        np.array([1.0]), np.array([1.0]), np.array([False]), {"p1": share}, {"p1": white}
    )
    said = told(scan.cloud, surface=check)[1]
    assert words in said
    assert ("pair p1" in said) == bool(words)


@pytest.mark.parametrize(
    ("count", "below_mm", "said"),
    [(2, 5.0, False), (4, 5.0, True), (4, 9.0, True), (4, 11.0, False)],
)
def test_what_lies_at_the_volume_s_top_and_side(count: int, below_mm: float, said: bool) -> None:
    """3 of 10,000 points, within 10 mm."""
    cloud = scattered([((0.0, 0.0), BODY, 0.0, TALL_MM)], [10_000])
    volume = Volume(top_mm=1900.0, radius_mm=600.0)
    high, wide = cloud.points.copy(), cloud.points.copy()
    high[:count, 2] = volume.top_mm - below_mm
    wide[:count] = [volume.radius_mm - below_mm, 0.0, 900.0]
    assert ("volume's top" in told(replace(cloud, points=high), volume=volume)[1]) == said
    assert ("volume's side" in told(replace(cloud, points=wide), volume=volume)[1]) == said


@pytest.mark.parametrize(
    ("share", "away_mm", "grade"),
    [
        (0.009, 20.0, "good"),
        (0.013, 20.0, "usable"),
        (0.19, 20.0, "usable"),
        (0.21, 20.0, "repeat"),
        (0.5, 13.0, "good"),
        (0.5, 17.0, "repeat"),
    ],
)
def test_points_that_the_mesh_has_no_surface_for(share: float, away_mm: float, grade: str) -> None:
    mesh = egg()
    rng = np.random.default_rng(0)
    out = rng.random(len(mesh.vertices)) < share
    points = mesh.vertices + away_mm * out[:, None] * mesh.normals
    assert told(cloud_of(points), mesh)[0] == grade


BESIDE: Column = ((0.0, 600.0), (100.0, 100.0), 0.0, TALL_MM)


@pytest.mark.parametrize(("tall", "two"), [(0.37, False), (0.44, True)])
def test_a_second_body_is_nearly_as_tall(tall: float, two: bool) -> None:
    columns = [((0.0, 0.0), BODY, 0.0, TALL_MM), (*BESIDE[:3], tall * TALL_MM)]
    grade, said = told(scattered(columns, [20_000, 4000]))
    assert ("two bodies" in said) == two
    assert grade == ("repeat" if two else "usable")


@pytest.mark.parametrize(
    ("count", "gap_mm", "said"), [(180, 300.0, False), (220, 300.0, True), (220, 30.0, False)]
)
def test_a_piece_that_nothing_joins(count: int, gap_mm: float, said: bool) -> None:
    """A hundredth of the points, farther off than cells of 50 mm reach."""
    columns = [
        ((0.0, 0.0), BODY, 0.0, TALL_MM),
        ((0.0, 150.0 + gap_mm + 25.0), (50.0, 50.0), 800.0, 900.0),
    ]
    assert ("not joined to the rest" in told(scattered(columns, [20_000, count]))[1]) == said


LEG, LEGS_END = (150.0, 150.0), 800.0
STANDING: list[Column] = [
    ((0.0, 0.0), BODY, LEGS_END, TALL_MM),
    ((0.0, 100.0), LEG, 0.0, LEGS_END),
    ((0.0, -100.0), LEG, 0.0, LEGS_END),
]


def said_of(columns: Sequence[Column]) -> str:
    return told(cloud_of(boxes(columns).vertices), boxes(columns))[1]


def square(area: float) -> tuple[float, float]:
    return float(np.sqrt(area)), float(np.sqrt(area))


@pytest.mark.parametrize(("share", "said"), [(0.33, False), (0.37, True)])
def test_a_second_trunk_is_told_from_an_arm_by_its_size(share: float, said: bool) -> None:
    other = ((0.0, 400.0), square(share * 90_000.0), 1100.0, 1500.0)
    assert ("more than one person" in said_of([*STANDING, other])) == said


@pytest.mark.parametrize(("trunk_mm2", "said"), [(23_000.0, False), (27_000.0, True)])
def test_arms_beside_a_neck_are_no_second_trunk(trunk_mm2: float, said: bool) -> None:
    columns = [
        ((0.0, 0.0), square(trunk_mm2), 0.0, TALL_MM),
        ((0.0, 400.0), square(0.9 * trunk_mm2), 1150.0, 1500.0),
    ]
    assert ("more than one person" in said_of(columns)) == said


@pytest.mark.parametrize(("area", "said"), [(1300.0, False), (1700.0, True)])
def test_limbs_beyond_those_of_one_person(area: float, said: bool) -> None:
    limbs = [((0.0, y), square(area), 1150.0, 1500.0) for y in (300.0, -300.0, 400.0)]
    assert ("more limbs than one" in said_of([*STANDING, *limbs])) == said
    assert "more limbs than one" not in said_of([*STANDING, *limbs[:2]])


@pytest.mark.parametrize(
    ("area", "low_mm", "said"), [(250.0, 0.0, False), (350.0, 0.0, True), (350.0, 600.0, False)]
)
def test_what_stands_beside_the_legs(area: float, low_mm: float, said: bool) -> None:
    """A stick; hands hang down no farther than 0.37 of the height."""
    stick = ((0.0, 400.0), square(area), low_mm, 1000.0)
    assert ("more than two legs" in said_of([*STANDING, stick])) == said


@pytest.mark.parametrize(("count", "lines"), [(5, 5), (6, 1)])
def test_rings_without_number_are_one_finding(
    scan: MadeScan, monkeypatch: pytest.MonkeyPatch, count: int, lines: int
) -> None:
    class Ring:
        y_mm, low_mm, high_mm = 0.0, 100.0, 200.0

    monkeypatch.setattr(scan_verdict, "rings", lambda *_: [Ring()] * count)
    assert told(scan.cloud, scan.mesh)[1].count("closed ring") == lines


@pytest.mark.parametrize(("apart_deg", "said"), [(43.0, True), (48.0, False)])
def test_cameras_that_stand_on_one_side(scan: MadeScan, apart_deg: float, said: bool) -> None:
    turn = np.radians([-apart_deg, apart_deg])
    middle = scan.cloud.points.mean(axis=0)
    way = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(2)])
    words = told(scan.cloud, scan.mesh, cameras=middle + 2000.0 * way)[1]
    assert ("one side only was seen" in words) == said


def test_two_thick_legs_are_of_one_person() -> None:
    """29,000 mm2 each, more than an arm beside a neck has."""
    legs = [((0.0, y), (170.0, 170.0), 0.0, LEGS_END) for y in (100.0, -100.0)]
    assert "more than one person" not in said_of([STANDING[0], *legs])


def test_soles_are_never_seen(scan: MadeScan) -> None:
    height = np.repeat(np.arange(0.0, TALL_MM, 50.0) + 25.0, 100)
    check = SurfaceCheck(height, np.ones(len(height)), height < 50.0, {}, {})
    assert told(scan.cloud, surface=check) == ("good", "")


@pytest.mark.parametrize(
    ("unknown_mm", "filled_mm", "said"),
    [(4.5, 0.0, True), (3.5, 0.0, False), (4.5, 19.0, True), (4.5, 21.0, False)],
)
def test_a_stature_is_a_guess_where_the_head_may_go_on_and_was_not_measured(
    scan: MadeScan,
    monkeypatch: pytest.MonkeyPatch,
    unknown_mm: float,
    filled_mm: float,
    said: bool,
) -> None:
    """Curls seen from all sides are held by no plane, but nothing of them is a guess."""

    class Known:
        highest = np.array([0.0, 0.0, 1500.0])

        def __init__(self) -> None:
            self.unknown_mm = unknown_mm

    monkeypatch.setattr(Crown, "of", lambda *_: Known())
    height, filled = np.array([1500.0, 1500.0 - filled_mm]), np.array([False, True])
    check = SurfaceCheck(height, np.ones(2), filled, {}, {})
    assert ("nothing was measured of the crown" in told(scan.cloud, surface=check)[1]) == said
