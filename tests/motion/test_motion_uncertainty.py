"""What a followed person's sigmas hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from living_body import LivingScan

from bodyscan.alignment.overlaps import OverlapPoints
from bodyscan.arrays import Array
from bodyscan.geometry.robust import rms
from bodyscan.motion.body_cells import BodyCells
from bodyscan.motion.body_motion import BodyMotion
from bodyscan.motion.body_parts import LEGS, PARTS, limb_weights, name_parts
from bodyscan.motion.breath import breath_along_normals
from bodyscan.motion.motion_kinds import MotionKind
from bodyscan.motion.motion_uncertainty import girth_sigmas, shape_sigmas
from bodyscan.settings import AlignmentSettings


@pytest.fixture(scope="module")
def cells(standing: LivingScan) -> BodyCells:
    """Of a person, as all pairs together show them."""
    spacing_mm = AlignmentSettings().spacing_mm
    both = [
        (standing.rig_from_camera[one.pair], OverlapPoints.from_image(one, spacing_mm))
        for one in standing.exact
    ]
    points = [place.apply(seen.inner.points) for place, seen in both]
    normals = [place.rotate(seen.inner.normals) for place, seen in both]
    return BodyCells.from_points(np.concatenate(points), np.concatenate(normals))[0]


def test_a_girth_is_uncertain_by_what_all_around_it_shares() -> None:
    """Errors of many cells, each by itself, cancel around a girth; one of them all does not."""
    height = np.repeat([1000.0, 1200.0], 50)
    alone, together = np.eye(100), np.ones((100, 1))
    np.testing.assert_allclose(girth_sigmas(together, height), 1.0)
    np.testing.assert_allclose(girth_sigmas(alone, height), 50.0**-0.5)


def shrunk(kind: MotionKind, size: float) -> MotionKind:
    """Known to be so small, if it is the person's."""
    if kind.precision is not None:
        return kind
    breath = kind.mode_covariance
    breath = None if breath is None else size**2 * np.eye(kind.modes.count)
    return replace(kind, size=size, mode_covariance=breath)


def test_what_stood_still_does_not_vouch_for_a_hip(cells: BodyCells) -> None:
    """Parts of people move by a share of their breath: by less no evidence makes them certain."""
    seconds = [0.0, 1.0]
    boards, sway = 1e-8 * np.eye(12), np.full(6, 1e-3)
    motion = BodyMotion.at_rest(cells, seconds, boards, sway)
    sizes = {kind.name: 0.01 for kind in motion.kinds} | {"breath": 3.0}
    motion = replace(motion, kinds=tuple(shrunk(kind, sizes[kind.name]) for kind in motion.kinds))
    names = [kind.name for kind in motion.kinds]
    known = {
        name: np.sqrt(np.diag(motion.covariance_with_min_parts()))[motion.slices[names.index(name)]]
        for name in names
        if name != "pose"
    }
    np.testing.assert_allclose(known.pop("parts"), 3.0 / 15.0)
    for name, own in known.items():
        np.testing.assert_allclose(own, sizes[name])


def test_a_breath_that_nobody_saw_is_known_to_a_share(
    cells: BodyCells, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a belly that two pairs saw, both breathed out, smoothness does not tell how full it
    was between them; of one that was seen there, and of legs, it has nothing to tell."""
    motion = BodyMotion.at_rest(cells, [0.0, 2.0, 4.0], 1e-8 * np.eye(18), np.full(6, 1e-3))
    breath = motion.slices[[kind.name for kind in motion.kinds].index("breath")].start
    courses = motion.kind("breath").modes.count
    amplitudes = np.zeros(len(motion.amplitudes))  # the trunk rises as one
    amplitudes[breath : breath + courses] = np.random.default_rng(5).standard_normal(courses)
    # Nothing else is unknown.
    sure = tuple(shrunk(kind, 1e-3) for kind in motion.kinds)
    motion = replace(motion, kinds=sure, amplitudes=amplitudes)
    monkeypatch.setattr(BodyMotion, "covariance_with_min_parts", lambda self: self.covariance)
    moved = motion.displacements(("breath",), from_middle=True)[..., :3]
    way = np.abs(np.einsum("pci,ci->pc", moved, cells.normals))
    every = np.ones((3, len(cells.centres)), bool)
    by_two = every.copy()
    by_two[1] = False
    fully, partly = (shape_sigmas(motion, cells, seen) for seen in (every, by_two))
    belly = breath_along_normals(cells) > 0.9
    nearest = np.minimum(way[0], way[2])[belly]
    assert rms(nearest) > 0.3
    # Two seconds are long, and a stance of then tells a twentieth of now.
    assert rms(partly[belly]) == pytest.approx(0.5 * rms(nearest), rel=0.25)
    assert rms(fully[belly]) < 0.4 * rms(partly[belly])
    legs = np.isin(name_parts(cells), [PARTS.index(leg) for leg in LEGS])
    assert rms(partly[legs]) < 0.1 * rms(partly[belly])


def certain(motion: BodyMotion) -> BodyMotion:
    """With amplitudes that are known."""
    return replace(motion, kinds=tuple(shrunk(kind, 1e-4) for kind in motion.kinds))


def with_amplitudes(motion: BodyMotion, name: str, values: Array) -> BodyMotion:
    amplitudes = motion.amplitudes.copy()
    own = motion.slices[[kind.name for kind in motion.kinds].index(name)]
    amplitudes[own] = np.broadcast_to(
        values[:, None], (len(values), motion.kind(name).modes.count)
    ).ravel()
    return replace(motion, amplitudes=amplitudes)


def test_how_far_an_arm_takes_the_shoulder_along_is_known_by_its_share(
    cells: BodyCells, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where half goes along, that is known to a third of a half squared; the rest of the arm, and of
    the trunk, to nothing."""
    monkeypatch.setattr(BodyMotion, "covariance_with_min_parts", lambda self: self.covariance)
    start = BodyMotion.at_rest(cells, [0.0, 1.0], 1e-10 * np.eye(12), np.full(6, 1e-3))
    motion = with_amplitudes(certain(start), "left arm", np.array([0.0, 0.0, 4.0]))
    seen = np.ones((2, len(cells.centres)), bool)
    share = limb_weights(cells)["left arm"]
    moved = motion.displacements(("left arm",), from_middle=True)[..., :3]
    whole = np.einsum("pci,ci->pc", moved, cells.normals) / np.maximum(share, 1e-12)
    expected = np.sqrt(np.mean(whole**2, axis=0) * share * (1.0 - share) / 3.0)
    assert expected.max() > 0.1
    found = shape_sigmas(motion, cells, seen)
    np.testing.assert_allclose(found, expected, atol=0.05 * expected.max())


def test_a_shoulder_that_breathes_with_the_chest_is_known_by_the_arms_share(
    cells: BodyCells, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The arm hangs still before a chest that swells: where the one passes into the other, it is
    not known how far the skin went; where an arm goes as far as the chest, it is."""
    monkeypatch.setattr(BodyMotion, "covariance_with_min_parts", lambda self: self.covariance)
    start = BodyMotion.at_rest(cells, [0.0, 0.4], 1e-10 * np.eye(12), np.full(6, 1e-3))
    count = start.kind("breath").fields.shape[2]
    motion = with_amplitudes(certain(start), "breath", np.eye(count)[0])
    seen = np.ones((2, len(cells.centres)), bool)
    sigma = shape_sigmas(motion, cells, seen)
    share = limb_weights(cells)["left arm"]
    front = cells.normals[:, 0] > 0.7
    trunk = name_parts(cells) == PARTS.index("trunk")
    border = front & trunk & (share > 0.2)
    chest = front & trunk & (share < 0.01) & (breath_along_normals(cells) > 0.8)
    assert border.any()
    assert chest.any()
    assert rms(sigma[border]) > 3.0 * rms(sigma[chest])


def test_a_place_that_two_saw_alike_is_as_uncertain_as_one_and_one_that_errs_by_itself_less(
    cells: BodyCells, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs' own errors average out over those who saw a place."""
    monkeypatch.setattr(BodyMotion, "covariance_with_min_parts", lambda self: self.covariance)
    boards = np.diag(np.tile([1e-12] * 3 + [0.1**2] * 3, 4))
    motion = certain(
        BodyMotion.at_rest(cells, [0.0, 0.0, 0.0, 0.0], boards, np.full(6, 1e-3))
    )._solve()
    seen = np.zeros((4, len(cells.centres)), bool)
    left = cells.centres[:, 1] > 0.0
    seen[0, left], seen[1, ~left] = True, True
    once = shape_sigmas(motion, cells, seen)
    seen[2, left], seen[3, ~left] = True, True
    twice = shape_sigmas(motion, cells, seen)
    assert rms(twice) == pytest.approx(rms(once) / np.sqrt(2.0), rel=0.05)
