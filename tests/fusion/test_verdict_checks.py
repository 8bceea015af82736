"""The checks of a scan's verdict: what each finding does to the grade of a scan otherwise good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from made_bodies import cloud_of, cylinder, ellipsoid, mesh_of, together
from made_scan import MadeScan, egg, make_scan
from standing_body import HAND_ON_HIP, hanging, standing_body
from verdict_given import verdict_given

from bodyscan.alignment.displaced_poles import DisplacedPole, DisplacementSearch
from bodyscan.alignment.icp import Alignment, Overlap
from bodyscan.alignment.pose_evidence import CommonError, ScaleError
from bodyscan.arrays import Array, Indices, Mask
from bodyscan.fusion.consistency import Contradictions
from bodyscan.fusion.verdict.evidence import Coverage, Seam, SeamReport
from bodyscan.fusion.verdict.rig import find_compressed, find_silent_poles
from bodyscan.mesh.body import BodyCloud
from bodyscan.motion.person_motion import PartMotion, PersonMotion
from bodyscan.reconstruction.range_image import Agreement
from bodyscan.registration.rig_calibration import NominalSize
from bodyscan.rig.rig import Volume
from bodyscan.verdict import Verdict

TALL_MM = 1700.0


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> MadeScan:
    return make_scan(tmp_path_factory.mktemp("scan"))


def alignment(motion_mm: float = 0.1, rms_mm: float = 0.1, expected_mm: float = 0.1) -> Alignment:
    overlap = Overlap("p1", "p2", 1000, rms_mm, rms_mm, expected_mm)
    return Alignment({}, {"p1": motion_mm, "p2": 0.0}, {}, (overlap,))


def seams(step_mm: float) -> SeamReport:
    """Of two pairs whose surfaces are displaced where they meet."""
    groups = {f"pair {name}": frozenset([name]) for name in ("p1", "p2")}
    return SeamReport((Seam(("p1", "p2"), np.full(9, step_mm), np.zeros(9)),), groups, ())


def contradictions(shares: dict[tuple[str, str], float], by_noise: float = 0.0) -> Contradictions:
    """Of 1000 comparisons of every two pairs."""
    names = sorted({name for both in shares for name in both})
    compared, against = np.zeros((2, len(names), len(names)), np.int64)
    for (one, other), share in shares.items():
        i, j = names.index(one), names.index(other)
        compared[i, j] = compared[j, i] = 1000
        against[i, j] = against[j, i] = round(1000 * share)
    return Contradictions(tuple(names), compared, against, by_noise)


def everywhere(share: float, by_noise: float = 0.0) -> Contradictions:
    return contradictions(dict.fromkeys(combinations("abc", 2), share), by_noise)


def person(left_mm: float) -> PersonMotion:
    return PersonMotion((PartMotion("trunk", 9.0, left_mm, 0.1),), None, None)


def step(shift_mm: float = 3.0, turn_deg: float = 0.1, **more: Any) -> DisplacedPole:
    return DisplacedPole("pole p1", frozenset({"p1-1", "p1-2"}), shift_mm, turn_deg, **more)


PAIR_STEP = DisplacedPole("pair p1-1", frozenset({"p1-1"}), 5.0, 0.1)
WARM = [
    replace(PAIR_STEP, name=f"pair {p}", pairs=frozenset({p}), shift_mm=0.4)
    for p in ("p1-1", "p2-1")
]
OTHER_STEP = DisplacedPole("pole p2", frozenset({"p2-1", "p2-2"}), 3.0, 0.1)
MISSING = "s01/{}/lit.png: is missing\n  Copy it here."


def displaced(rms_mm: float, sway_mm: float = 0.1) -> DisplacementSearch:
    return DisplacementSearch(None, 1.0, sway_mm, rms_mm)


def boards(sigma_mm: float) -> dict[str, float]:
    return dict.fromkeys(("p1", "p2", "p3"), sigma_mm)


# 1 mm all round costs 6.3 mm of girth; 2 mm of girth are good, 4 usable.
FINDINGS: dict[str, tuple[dict[str, Any], str, str]] = {
    "nothing": ({}, "good", ""),
    "some motion": ({"alignment": alignment(4.0)}, "usable", "moved by 4.0 mm between the pairs"),
    "much motion": ({"alignment": alignment(7.0)}, "repeat", "(pair p1)"),
    "motion that boards explain": ({"alignment": alignment(5.0), "boards_mm": boards(1.5)}, "good", ""),
    "motion beyond the boards": ({"alignment": alignment(5.0), "boards_mm": boards(1.0)}, "usable", ""),
    "a person well followed": ({"person": person(0.5)}, "good", ""),
    "a person followed": ({"person": person(0.8)}, "usable", "0.8 mm are left after correction"),
    "a person badly followed": ({"person": person(2.2)}, "repeat", "the trunk moved by 9.0 mm"),
    "a seam": ({"seams": seams(0.5)}, "usable", "displaced by 0.5 mm where it meets theirs"),
    "a large seam": ({"seams": seams(0.7)}, "repeat", "pair p"),
    "isolated pairs": (
        {"seams": SeamReport((), {}, (("p3-1", "p3-2"),))}, "usable", "p3-1, p3-2 shares no surface"),
    "noise": ({"alignment": alignment(0.1, 0.45)}, "usable", "disagree by 0.45 mm RMS"),
    "contradictions by noise": ({"contradictions": everywhere(0.03, 0.026)}, "good", ""),
    "contradictions": ({"contradictions": everywhere(0.01)}, "usable", "the pairs disagree"),
    "a hand": ({"contradictions": replace(everywhere(0.001), double=2)}, "good", ""),
    "an arm": ({"contradictions": replace(everywhere(0.001), double=3)}, "usable", "an arm or the"),
    "JPEG": ({"contradictions": everywhere(0.01), "compressed": tuple("ab")}, "usable", "as JPEG"),
    "gamma": ({"contradictions": everywhere(0.01), "nonlinear": tuple("ab")}, "usable", "video gamma"),
    "gamma that does no harm": ({"nonlinear": tuple("ab")}, "good", ""),
    "many contradictions": ({"contradictions": everywhere(0.03)}, "repeat", "disagree: at"),
    # A focal length wrong by 1 %, taken for a pole that moved, costs 16.6 mm of girth.
    "contradictions of an aligned pole": (
        {"contradictions": everywhere(0.009), "displaced": [step()]}, "repeat", "even with the"),
    "a pole that moved": ({"displaced": [step()]}, "usable", "pole p1 is displaced by 3.0 mm"),
    "a pair that moved": ({"displaced": [PAIR_STEP]}, "repeat", "pair p1-1 is displaced by 5.0 mm"),
    "two poles that moved": ({"displaced": [step(), OTHER_STEP]}, "repeat", "pole p1, pole p2 are dis"),
    "warm cameras": ({"displaced": WARM}, "usable", "pair p1-1, pair p2-1 are displaced"),
    "one of all poles": ({"displaced": [step(all_moved=True)]}, "repeat", "pole p1 is displaced"),
    "a pole that turned": ({"displaced": [step(200.0, 14.0)]}, "usable", "pole p1 is displaced by 200"),
    "a person who turned": ({"displaced": [step(5.0, 14.0)]}, "repeat", "person turned by 14 degrees"),
    "poles farther out": ({"common_error": ScaleError(0.5, 0.1)}, "usable", "farther from the body"),
    "poles farther in": ({"common_error": ScaleError(-3.0, 0.1)}, "repeat", "would be 19 mm too large"),
    "all pairs alike": (
        {"common_error": CommonError((0.3, 0.0, 0.4), 0.02)}, "usable", "one cause, not poles"),
    "all pairs alike by much": (
        {"common_error": CommonError((0.0, 2.0, 0.0), 0.0)}, "repeat", "warm up and calibrate again"),
    "times ten times too long": ({"other_times": "0.1 x"}, "usable", "frame times 0.1 x those"),
    "nominal size": ({"nominal": NominalSize(0.98)}, "good", ""),
    "doubtful size": ({"nominal": NominalSize(1.04)}, "usable", "1.040 times as far apart"),
    "wrong size": ({"nominal": NominalSize(1.11)}, "repeat", "1.110 times as far apart"),
    "floor at 3 mm": ({"floor_mm": -3.0}, "good", ""),
    "floor at 12 mm": ({"floor_mm": 12.0}, "usable", "girths are taken 12 mm too low"),
    "floor of a pole that moved": (
        {"floor_mm": -12.0, "displaced": [step()]}, "repeat", "the floor is at -12 mm, not at 0"),
    "a silent pole": ({"silent": ["p3"]}, "usable", "pole p3 saw nobody where the others"),
    "a refused pair": (
        {"alignment": Alignment({}, {"p1": 0.1}, {"p2": 7.0}, ())}, "repeat", "pair p2 does not fit"),
    "an imported calibration": ({"unjudged": ("p1", "p2")}, "usable", "calibration of p1, p2 was imp"),
    "two stripe directions": (
        {"agreements": {"p1": Agreement(5.0, 2.0, 160)}}, "usable", "two stripe directions"),
    "pairs in place": ({"search": displaced(0.25)}, "good", ""),
    "pairs displaced": ({"search": displaced(0.5)}, "usable", "the pairs are displaced by 0.5 mm RMS"),
    "pairs displaced, as calibrated": (
        {"search": displaced(0.5), "boards_mm": boards(0.7)}, "good", ""),
    "pairs displaced by much": ({"search": displaced(0.9)}, "repeat", "take a board shot"),
    "pairs displaced while swaying": ({"search": displaced(0.9, 2.0)}, "usable", "head or arms moved"),
}  # fmt: skip


@pytest.mark.parametrize("name", FINDINGS)
def test_findings_by_their_cost(scan: MadeScan, name: str) -> None:
    given, grade, words = FINDINGS[name]
    verdict = verdict_given(scan.cloud, scan.mesh, **{"alignment": alignment(), **given})
    assert verdict.grade == grade, str(verdict)
    assert words.lower() in str(verdict).lower()
    assert grade != "good" or not verdict.reasons


@pytest.mark.parametrize("factor", [1.0, 0.1])
def test_lengths_in_centimetres_come_first(scan: MadeScan, factor: float) -> None:
    points = scan.cloud.points * (1700.0 * factor / np.ptp(scan.cloud.points, axis=0).max())
    cameras = points.mean(axis=0) + 1500.0 * factor * np.eye(3)
    verdict = verdict_given(replace(scan.cloud, points=points), cameras=cameras)
    assert ("is square_mm of the boards in mm?" in "".join(verdict.reasons[:1])) == (factor < 1.0)


def test_pairs_that_failed_for_the_same_reason_share_a_line(scan: MadeScan) -> None:
    failed = {name: MISSING.format(name) for name in ("p1-1", "p1-2")} | {"p2-1": "too dark"}
    assert verdict_given(scan.cloud, failed=failed) == Verdict(
        "usable",
        (
            "left out: p1-1, p1-2: s01/p1-1/lit.png: is missing\n  Copy it here.",
            "left out: p2-1: too dark",
        ),
    )


def test_blocks_are_seen() -> None:
    grey = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8), None, 3
    )
    packed = cv2.imdecode(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 40])[1], 0)
    cut = np.pad(grey[160:320, 160:480], 160)  # a sensor read in part: no blocks
    for lit, pairs in ((grey, ()), (cut, ()), (packed, ("a",))):
        assert find_compressed([SimpleNamespace(pair="a", lit=lit)]) == pairs  # type: ignore


def test_a_pole_is_silent_if_several_pairs_saw_nobody() -> None:
    poles = {"a1": "a", "a2": "a", "b1": "b", "b2": "b", "c1": "c"}
    working = ["a1", "a2", "b1", "b2", "c1", "alone"]
    assert find_silent_poles(poles, working, ["a1"]) == ("b",)
    assert find_silent_poles(poles, working, ["a1", "b2"]) == ()
    assert find_silent_poles(poles, working, []) == ("a", "b")


POLES = {
    **{f"pair {name}": frozenset([name]) for name in ("a1", "a2", "b1", "b2", "c1")},
    **{f"pole {name}": frozenset([f"{name}1", f"{name}2"]) for name in "ab"},
}
EVERY = list(combinations(["a1", "a2", "b1", "b2", "c1"], 2))


@pytest.mark.parametrize(
    ("wrong", "outlier"),
    [
        (
            {("a1", "b1"), ("a1", "b2"), ("a1", "c1"), ("a2", "b1"), ("a2", "b2"), ("a2", "c1")},
            "pole a",
        ),
        ({("a1", "a2"), ("a1", "b1"), ("a1", "b2"), ("a1", "c1")}, "pair a1"),
        (set(EVERY), ""),
    ],
)
def test_the_outlier_is_the_pole_or_pair_that_contradicts_the_others(
    wrong: set[tuple[str, str]], outlier: str
) -> None:
    found = contradictions({both: 0.1 if both in wrong else 0.002 for both in EVERY})
    assert found.find_outlier(POLES) == outlier


def test_contradictions_are_counted_by_pair() -> None:
    """Samples 0 to 9 are the first pair's, 10 to 19 the second's."""
    samples: Any = SimpleNamespace(
        starts=np.array([0, 10, 20]),
        sigma_mm=np.full(20, 0.3),
        points=np.outer(np.arange(20.0), [0.0, 0.0, 10.0]),
        colours=np.full((20, 1), 90, np.uint8),
    )
    surface: Any = SimpleNamespace(sigma_mm=np.full(50, 0.4))

    def compared(agreed: list[int], against: list[int]) -> Any:
        index, other = np.array(agreed, np.int64), np.array(against, np.int64)
        return SimpleNamespace(index=index, at=index, against_index=other, against_at=other)

    both = [compared([10, 12, 19], [11]), compared([0, 9], [1, 2, 3])]
    found = Contradictions.count(["a", "b"], both, samples, [surface, surface], 1.5)
    assert found.compared.tolist() == [[0, 4], [5, 0]]
    assert found.against.tolist() == [[0, 1], [3, 0]]
    assert found.heights_mm == pytest.approx((13.0, 86.0))
    # Hair and dark cloth do not count.
    samples.colours[[1, 12]] = 20
    fewer = Contradictions.count(["a", "b"], both, samples, [surface, surface], 1.5)
    assert (fewer.compared.tolist(), fewer.against.tolist()) == ([[0, 3], [4, 0]], [[0, 1], [2, 0]])
    # Both points' sigmas are 0.5 mm: noise exceeds three of them once in 370 times.
    assert found.by_noise == pytest.approx(0.0027, rel=1e-2)
    assert found.beyond_noise == pytest.approx(4.0 / 9.0 - 0.0027, abs=1e-4)
    none = [compared([], [])] * 2
    assert Contradictions.count(["a", "b"], none, samples, [surface] * 2, 1.5).beyond_noise == 0.0


BANDS = np.repeat(np.arange(0.0, TALL_MM, 50.0) + 25.0, 100)
FACE = np.tile(np.arange(100), len(BANDS) // 100)  # a hundred in every 50 mm of height, numbered


def coverage(filled: Mask, **pair: float) -> Coverage:
    share, white = pair.get("share", 1.0), pair.get("white", 0.0)
    shares, none = ({"p1": share}, {"p1": white}), np.zeros_like(filled)
    return Coverage(BANDS, np.ones(len(BANDS)), filled, *shares, none)


def test_causes_that_only_together_explain_a_gap_come_before_it(scan: MadeScan) -> None:
    failed = {"p1": "too dark", "p2": "too bright", "p3": "is missing"}
    left_out = tuple(f"left out: {name}: {reason}" for name, reason in failed.items())
    for calibrated in (True, False):  # where others look is not known
        gap = replace(coverage(FACE < 40), missed=(FACE < 40) & calibrated)
        absent = frozenset(failed if calibrated else ())
        verdict = verdict_given(scan.cloud, coverage=gap, failed=failed, absent=absent)
        found = verdict.grade, verdict.reasons[:3], verdict.consequences[0][:3]
        assert found == ("repeat", left_out, "at ")
    jpeg: dict[str, Any] = {"compressed": ("p1", "p2"), "boards_mm": boards(0.1)}
    reasons = verdict_given(scan.cloud, coverage=coverage(FACE < 20), **jpeg).reasons
    assert [words[:22] for words in reasons] == ["images were compressed"]


@pytest.mark.parametrize(
    ("given", "grade", "words"),
    [
        (coverage(FACE < 10), "good", ""),
        (coverage(FACE < 20), "usable", "20% of the surface was not measured"),
        (coverage(FACE < 60), "repeat", "60% of the surface was not measured"),
        (coverage(FACE < 100), "repeat", "next to nothing was measured: 0.0 cm² in all"),
        (coverage((BANDS < 50.0) | (FACE < 2)), "good", ""),  # soles are never seen
        (coverage((FACE < 60) & (BANDS == 625.0)), "usable", "measured from 600 to 650 mm"),
        (coverage((FACE < 40) & (BANDS == 625.0)), "good", ""),
        (coverage((FACE < 60) & (BANDS > TALL_MM - 50.0)), "good", ""),  # the crown
        (coverage(FACE < 0, share=0.8), "good", ""),
        (coverage(FACE < 0, share=0.5), "usable", "pair p1 measured 50% of the skin that it sees"),
        (coverage(FACE < 0, share=0.5, white=0.1), "usable", "pair p1 is overexposed: 10%"),
    ],
)
def test_coverage(scan: MadeScan, given: Coverage, grade: str, words: str) -> None:
    verdict = verdict_given(scan.cloud, coverage=given)
    assert (verdict.grade, words in str(verdict)) == (grade, True), str(verdict)
    assert len(set(verdict.reasons)) == len(verdict.reasons)


def test_the_stature_is_a_guess_if_the_crown_may_be_higher(scan: MadeScan) -> None:
    """Of a crown that is measured to its hairline the planes around bound nothing."""
    top = float(scan.cloud.points[:, 2].max())
    check = Coverage(np.array([top]), np.ones(1), np.array([True]), {}, {}, np.array([False]))
    kept = scan.cloud.points[:, 2] < top - 200.0
    below = replace(scan.cloud, points=scan.cloud.points[kept], normals=scan.cloud.normals[kept])
    assert "the stature is a guess" not in str(verdict_given(scan.cloud, coverage=check))
    assert "the stature is a guess" in str(verdict_given(below, coverage=check))


@pytest.mark.parametrize(("angle_deg", "reported"), [(40.0, True), (50.0, False)])
def test_cameras_on_one_side(scan: MadeScan, angle_deg: float, reported: bool) -> None:
    turn = np.radians([-angle_deg, angle_deg])
    directions = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(2)])
    cameras = scan.cloud.points.mean(axis=0) + 2000.0 * directions
    words = str(verdict_given(scan.cloud, scan.mesh, cameras=cameras))
    assert ("saw only one side" in words) == reported


Column = tuple[tuple[float, float], tuple[float, float], float, float]
"""Centre and sides in the plane, lowest and highest mm."""


def facing_x(points: Array) -> BodyCloud:
    return cloud_of(points, np.array([1.0, 0.0, 0.0]), 1.0)


def scattered(columns: Sequence[Column], counts: Sequence[int]) -> BodyCloud:
    """Points all through some columns."""
    rng = np.random.default_rng(0)
    parts = [
        rng.uniform([x - a / 2, y - b / 2, low], [x + a / 2, y + b / 2, high], (count, 3))
        for ((x, y), (a, b), low, high), count in zip(columns, counts, strict=True)
    ]
    return facing_x(np.concatenate(parts))


TRUNK: Column = ((0.0, 0.0), (300.0, 300.0), 0.0, TALL_MM)
SHAPES = ("more than one person", "besides one person's", "touches the", "mm wide and")
PERSON = standing_body(hanging(25.0))
AT_CROTCH = [*hanging(25.0), ((0, 480, 805), (0, 150, 805), 22)]


def beside(thing: tuple[Array, Indices]) -> tuple[Array, Indices]:
    return together(PERSON, (thing[0] + [0.0, 900.0, 0.0], thing[1]))


@pytest.mark.parametrize(
    ("body", "grade", "words"),
    [
        (PERSON, "good", ""),
        (standing_body(hanging(25.0), scale=0.6), "good", ""),
        (standing_body(hanging(20.0), stout=1.25), "good", ""),
        (standing_body(hanging(25.0), apart_mm=66.0), "good", ""),  # thighs that touch
        (standing_body(hanging(0.0)), "usable", "the left arm touches the"),
        (standing_body(HAND_ON_HIP), "usable", "hold the arms off"),
        (standing_body(AT_CROTCH), "usable", "leg and trunk"),
        (beside(PERSON), "repeat", "more than one person: at heights"),
        (beside(cylinder(15.0, 0.0, 1000.0)), "usable", "a stick"),
        (beside(cylinder(130.0, 0.0, 450.0)), "usable", "causes: a stool"),
        (ellipsoid((150.0, 850.0, 150.0), (0.0, 0.0, 150.0)), "usable", "1700 mm wide and 300 mm"),
    ],
)
def test_shapes(body: tuple[Array, Indices], grade: str, words: str) -> None:
    mesh = mesh_of(*body)
    found = verdict_given(facing_x(mesh.vertices[:: 1 if words.startswith("1700") else 2]), mesh)
    shape = [line for line in found.reasons if any(one in line for one in SHAPES)]
    assert words in str(shape)
    assert (grade == "good") == (not shape)
    assert grade != "repeat" or found.grade == "repeat"


@pytest.mark.parametrize(
    ("columns", "counts", "grade", "words"),
    [
        ([TRUNK, ((0.0, 600.0), (100.0, 100.0), 0.0, 600.0)], [20_000, 4000], "usable", "a piece"),
        (
            [TRUNK, ((0.0, 600.0), (100.0, 100.0), 0.0, 900.0)],
            [20_000, 4000],
            "repeat",
            "two bodies",
        ),
        ([TRUNK, ((0.0, 475.0), (50.0, 50.0), 800.0, 900.0)], [20_000, 150], "good", ""),
        (
            [TRUNK, ((0.0, 475.0), (50.0, 50.0), 800.0, 900.0)],
            [20_000, 250],
            "usable",
            "not joined",
        ),
        ([TRUNK, ((0.0, 205.0), (50.0, 50.0), 800.0, 900.0)], [20_000, 250], "good", ""),
    ],
)
def test_pieces(columns: Sequence[Column], counts: list[int], grade: str, words: str) -> None:
    verdict = verdict_given(scattered(columns, counts))
    assert verdict.grade == grade, str(verdict)
    assert words in str(verdict)


@pytest.mark.parametrize(("count", "below_mm", "cut"), [(2, 5.0, 0), (9, 5.0, 1), (9, 12.0, 0)])
def test_bodies_cut_off_by_the_scan_volume(count: int, below_mm: float, cut: int) -> None:
    cloud, volume = scattered([TRUNK], [10_000]), Volume(top_mm=1900.0, radius_mm=600.0)
    high, wide = cloud.points.copy(), cloud.points.copy()
    high[:count, 2] = volume.top_mm - below_mm
    wide[:count] = [volume.radius_mm - below_mm, 0.0, 900.0]
    for points, side in ((high, "top, 1900 mm"), (wide, "side, 600 mm")):
        found = str(verdict_given(replace(cloud, points=points), volume=volume))
        assert found.count(f"cut off at the scan volume's {side}") == cut


@pytest.mark.parametrize(
    ("share", "away_mm", "grade"),
    [(0.005, 20.0, "good"), (0.1, 20.0, "usable"), (0.3, 20.0, "repeat"), (0.5, 12.0, "good")],
)
def test_points_without_a_surface_in_the_mesh(share: float, away_mm: float, grade: str) -> None:
    mesh = egg()
    out = np.random.default_rng(0).random(len(mesh.vertices)) < share
    points = mesh.vertices + away_mm * out[:, None] * mesh.normals
    assert verdict_given(facing_x(points), mesh).grade == grade
