"""Poles that stand off are told from a person who sways, breathes and moves the arms meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from living_body import STANDING, LivingScan, cast_living, known_to
from ray_cast_scan import load_rig

from bodyscan.alignment.displaced_poles import DisplacedPole, DisplacementSearch
from bodyscan.alignment.icp import align
from bodyscan.alignment.pose_evidence import CommonError, ScaleError
from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.motion import estimation, person_alignment
from bodyscan.motion.person_alignment import PersonAlignment, align_person
from bodyscan.motion.person_motion import describe_posture
from bodyscan.settings import AlignmentSettings

RIG = load_rig("four-pole-16")


@pytest.fixture(scope="module")
def sound(standing: LivingScan) -> PersonAlignment:
    return together(standing, {})


def outward(scan: LivingScan) -> dict[str, Array]:
    """(3,) of each pair: level, from the rig's middle to its pole."""
    ways = {name: at.translation * [1.0, 1.0, 0.0] for name, at in scan.rig_from_camera.items()}
    return {name: way / np.linalg.norm(way) for name, way in ways.items()}


def together(
    scan: LivingScan, moved_mm: Mapping[str, float], *, timed: bool = True
) -> PersonAlignment:
    """moved_mm: by how much the calibration has each pole too far out."""
    out = outward(scan)
    placed = {
        name: RigidTransform(
            at.rotation, at.translation + moved_mm.get(RIG.poles[name], 0.0) * out[name]
        )
        for name, at in scan.rig_from_camera.items()
    }
    images = [
        replace(image, time_ms=1e3 * scan.seconds[image.pair] if timed else None)
        for image in scan.images
    ]
    boards = known_to(placed, 0.03, 0.002)
    settings = AlignmentSettings()
    aligned = align(images, placed, boards, settings)
    return align_person(images, placed, aligned, boards, RIG.poles, settings)


def outward_mm(found: PersonAlignment, scan: LivingScan) -> float:
    """How far the pairs stand farther out than they do, in the mean."""
    out, stands = outward(scan), found.alignment.rig_from_camera
    moved = {n: stands[n].translation - at.translation for n, at in scan.rig_from_camera.items()}
    return float(np.mean([step @ out[name] for name, step in moved.items()]))


def test_a_person_who_stands_is_no_pole(sound: PersonAlignment) -> None:
    assert sound.motion is not None
    assert (sound.displaced, sound.common_error, sound.other_times) == ((), None, "")


def test_poles_that_all_stand_farther_out_make_no_person_fatter(
    standing: LivingScan, sound: PersonAlignment
) -> None:
    """Taken for a sway round all poles in turn, 3 mm left a girth 13 mm off, graded good."""
    found = together(standing, dict.fromkeys(sorted(set(RIG.poles.values())), 1.0))
    assert isinstance(found.common_error, ScaleError)
    assert found.common_error.outward_mm == pytest.approx(-1.0, abs=0.3)
    assert found.displaced == ()
    # Pairs also went where the person did.
    assert outward_mm(found, standing) == pytest.approx(outward_mm(sound, standing), abs=0.3)


@pytest.mark.parametrize(("out_mm", "turned_deg"), [(5.0, 0.0), (0.0, 2.0)])
def test_a_pole_that_moved_while_a_person_sways_is_found(
    out_mm: float, turned_deg: float, standing: LivingScan
) -> None:
    """As one turned, all frame times seemed ten times too short."""
    turn = RigidTransform.from_rotation_vector(np.radians([turned_deg, 0.0, 0.0]), np.zeros(3))
    placed = standing.rig_from_camera
    turned = {n: turn @ at if RIG.poles[n] == "p1" else at for n, at in placed.items()}
    found = together(replace(standing, rig_from_camera=turned), {"p1": out_mm})
    assert ([step.name for step in found.displaced], found.other_times) == (["pole p1"], "")
    assert found.common_error is None


def displace(scan: LivingScan, displacement: Callable[[str, Array], Array]) -> LivingScan:
    """Add to each pair's points, rig frame, a displacement (h, w, 3) that follows from them."""
    images = []
    for image in scan.images:
        pose = scan.rig_from_camera[image.pair]
        points = pose.apply(image.points.astype(float))
        points += displacement(image.pair, points)
        images.append(replace(image, points=pose.inverse().apply(points).astype(np.float32)))
    return replace(scan, images=images)


def draw_belly_in(scan: LivingScan, pole: str, mm: float) -> LivingScan:
    """While the pole fired; she faces x."""

    def inward(pair: str, points: Array) -> Array:
        x, y, z = np.moveaxis(points, -1, 0)
        front = np.clip(x / 60.0, 0.0, 1.0) * (np.abs(y) < 200.0) * (RIG.poles[pair] == pole)
        return np.multiply.outer(front * np.exp(-(((z - 1000.0) / 100.0) ** 2)), [-mm, 0.0, 0.0])

    return displace(scan, inward)


def test_a_belly_drawn_in_while_one_pole_fired_is_no_pole(
    standing: LivingScan, sound: PersonAlignment
) -> None:
    """The mean of both was graded good, with girths 8 mm off and known to 0.1."""
    found: Any = together(draw_belly_in(standing, "p1", 10.0), {})
    assert (sound.posture, found.displaced, found.common_error) == (None, (), None)
    # p4, beside it, explains it nearly as well.
    assert found.posture.pole in ("pole p1", "pole p1 or pole p4")
    assert describe_posture(found.motion).startswith("the belly was")
    assert describe_posture(found.motion).endswith("farther in")
    assert found.motion.breath is not None
    assert found.motion.breath.sigma_mm.max() > 3.0, "girths hold both"


def test_all_cameras_that_see_too_far_right_are_one_cause(standing: LivingScan) -> None:
    """Six pairs were named that had moved by themselves."""
    shift = RigidTransform.from_translation(np.array([1.5, 0.0, 0.0]))
    rig_from_camera = {name: at @ shift for name, at in standing.rig_from_camera.items()}
    found = together(replace(standing, rig_from_camera=rig_from_camera), {})
    assert isinstance(found.common_error, CommonError)
    assert found.common_error.shift_mm == pytest.approx(1.5, abs=0.6)
    assert (found.displaced, found.other_times) == ((), "")


@pytest.mark.parametrize("factor", [10.0, 0.0, 1e-6])
def test_moments_in_another_unit_or_order_blame_no_pole(
    factor: float, standing: LivingScan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With `frame_ms` ten times too large, or if all pairs fired at once, a pole had moved."""
    seconds = {name: factor * at for name, at in standing.seconds.items()}
    found: Any = together(replace(standing, seconds=seconds), {})
    assert found.other_times == ("0.1 x" if factor > 1.0 else "in another order than")
    assert (found.displaced, found.posture) == ((), None)
    assert found.motion.moment_ms is None, "they are not used"
    if factor > 1.0:  # what hardly moved shows no times
        monkeypatch.setattr("bodyscan.motion.estimation.STILL_MM", 40.0)
        assert together(replace(standing, seconds=seconds), {}).other_times == ""


def test_moments_of_one_pole_blame_no_pole() -> None:
    """It seemed displaced by 0.5 mm."""
    scan = cast_living(RIG, replace(STANDING, sway_mm_s=15.0), poles=4)
    seconds = {n: at + 0.3 * (RIG.poles[n] == "p2") for n, at in scan.seconds.items()}
    found = together(replace(scan, seconds=seconds), {})
    assert (found.displaced, found.other_times) == ((), "of p2 other than")
    two: Any = SimpleNamespace()
    two.log_evidence = lambda at, *_: -50.0 * np.nanvar(np.array(at, float) - range(6))
    clocks = partial(estimation._Solution.fit_clocks, two, "uvwxyz", [0, 4, 2, 3, 1, 5], "aabbcc")
    assert ["v and y" in clocks(step) for step in (0.0, 130.0, 150.0)] == [True, True, False]


def test_hips_that_shift_are_no_other_moments(standing: LivingScan) -> None:
    """Weight that goes from leg to leg is no lean: frame times seemed ten times too short."""

    def sideways(pair: str, points: Array) -> Array:
        hips = 6.0 * np.exp(-(((points[..., 2] - 900.0) / 250.0) ** 2))
        return np.multiply.outer(hips, [0.0, np.sin(np.pi * standing.seconds[pair]), 0.0])

    assert together(displace(standing, sideways), {}).other_times == ""


def test_without_moments_nobody_can_tell(standing: LivingScan) -> None:
    """Any pair may then have seen any stance, and what sways alike in neighbours looks like a pole."""
    found = together(standing, {"p1": 5.0}, timed=False)
    assert (found.displaced, found.common_error) == ((), None)


FOLLOWED, PLACES = SimpleNamespace(), SimpleNamespace(other_times=("", 0.0), fit_clocks=str)


def step(name: str, *pairs: str, all_moved: bool = False) -> DisplacedPole:
    return DisplacedPole(name, frozenset(pairs), 3.0, 0.1, all_moved)


@pytest.mark.parametrize(
    ("followed", "told", "freed", "connected", "shift_mm"),
    [
        # Nobody was followed, or what they did says nothing of places: what stands off by itself.
        (None, PLACES, ["pole a"], ("a1", "a2", "b1"), 0.0),
        (FOLLOWED, None, ["pole a"], ("a1", "a2", "b1"), 0.0),
        # Where no overlap connects it to the others at last, it is as it was found.
        (FOLLOWED, None, ["pole a"], ("b1",), 3.0),
        (FOLLOWED, None, ["pole a"], ("a1",), 3.0),
        # Else what a person's whole motion leaves for poles to explain: 30 mm are no clock's.
        (FOLLOWED, PLACES, ["pole b"], ("a1", "a2", "b1"), 0.0),
    ],
)
def test_poles_are_set_free_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
    followed: Any,
    told: Any,
    freed: list[str],
    connected: tuple[str, ...],
    shift_mm: float,
) -> None:
    by_search, by_motion = [step("pole a", "a1", "a2")], list[Any]()
    if followed and told:
        doubtful = replace(step("pole a", "a1", "a2"), certain=False)
        by_motion = [doubtful, replace(step("pole b", "b1"), shift_mm=30.0), ScaleError(1.0, 0.1)]
    given, names = list[Any](), ("a1", "a2", "b1")
    boards = PoseCovariance(names, np.eye(18))

    def search(*of: Any) -> DisplacementSearch:
        return DisplacementSearch(by_search.pop(0) if by_search else None, 0.5)

    def aligned(images: Any, placed: Any, loose: PoseCovariance, settings: Any) -> Any:
        given.append(np.diag(loose.matrix)[3::6] > 1.0)
        return "aligned anew"

    monkeypatch.setattr(PLACES, "fit_clocks", lambda: "asked" if len(by_motion) == 1 else "")
    patch = partial(monkeypatch.setattr, person_alignment)
    patch("_search", search)
    patch("estimate_motion", lambda *of: ("alignment", followed, told))
    patch("detect_displacement", lambda *of: by_motion.pop(0) if by_motion else None)
    patch("align", aligned)
    patch("_select_connected_motions", lambda *of: dict.fromkeys(connected, np.zeros(6)))
    no: Any = None
    found = align_person(no, no, no, boards, {"a1": "a", "a2": "a"}, no)
    assert [one.name for one in found.displaced] == freed
    assert [one.shift_mm for one in found.displaced] == [shift_mm]
    if freed == ["pole a"]:
        assert found.common_error is None
        assert [one.tolist() for one in given] == [[True, True, False]]
    else:
        assert found.common_error == ScaleError(1.0, 0.1)
        # A pole in doubt, of which nothing is said, another, then each pole: of a size all stand off.
        assert [one.tolist() for one in given] == [[True, True, False], [True] * 3, [True] * 3]
    assert found.motion is followed


@pytest.mark.parametrize(("followed", "offset_mm"), [(FOLLOWED, 0.05), (None, 0.5)])
def test_what_a_followed_head_moved_by_is_no_place_of_a_pair_s_own(
    monkeypatch: pytest.MonkeyPatch, followed: Any, offset_mm: float
) -> None:
    """A child who moved her head by 11 mm was told that pairs stood 0.5 mm off."""
    apart = {"first": 0.5, "followed": 0.05}
    patch = partial(monkeypatch.setattr, person_alignment)
    patch("_search", lambda _, __, at, *of: DisplacementSearch(None, 0.5, 2.7, apart[at]))
    patch("estimate_motion", lambda *of: ("followed", followed, None))
    monkeypatch.setattr(person_alignment, "_select_connected_motions", lambda *of: {})
    nothing, first = list[Any]([None, "first"])
    boards = PoseCovariance(("a",), np.eye(6))
    found = person_alignment.align_person(nothing, nothing, first, boards, {}, nothing)
    assert found.search == DisplacementSearch(None, 0.5, 2.7, offset_mm)
