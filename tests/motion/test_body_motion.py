"""Kinds of motion on three cells and two pairs, against sums written out; and what sigmas hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from living_body import LivingScan
from scipy import sparse

from bodyscan.alignment.overlaps import OverlapPoints
from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.robust import rms
from bodyscan.motion import body_motion
from bodyscan.motion.body_cells import BodyCells
from bodyscan.motion.body_motion import BodyMotion, compute_girth_sigmas, compute_shape_sigmas
from bodyscan.motion.body_parts import find_ankles
from bodyscan.motion.breath import BreathEstimate
from bodyscan.motion.motion_kinds import MotionKind, build_kinds
from bodyscan.motion.temporal_modes import Breaths, TemporalModes
from bodyscan.settings import AlignmentSettings

PAIRS, CELLS = 2, 3
RNG = np.random.default_rng(5)
NORMALS = np.array([[1.0, 0, 0], [0, 0.6, 0.8], [0, 0, 1.0]])
COURSES = TemporalModes(RNG.normal(size=(PAIRS, 2)), RNG.normal(size=2))
KNOWN = np.diag(RNG.uniform(1.0, 3.0, 6 * PAIRS))
CONSTANT = TemporalModes(np.eye(PAIRS), np.zeros(PAIRS))
POSE = MotionKind("pose", RNG.normal(size=(CELLS, 12, 6)), CONSTANT, 1.0, KNOWN)
PARTS = MotionKind("parts", RNG.normal(size=(CELLS, 12, 3)), COURSES, 0.8)
COUNT = 6 * PAIRS + 3 * 2


def seen(kinds: tuple[MotionKind, ...] = (POSE, PARTS)) -> tuple[BodyMotion, Array]:
    """A motion with what was seen of it, solved, and that as a whole matrix."""
    count = sum(kind.count for kind in kinds)
    root = np.random.default_rng(6).normal(size=(count, 30))
    square, pull = root @ root.T, root @ np.random.default_rng(7).normal(size=30)
    nothing: Any = None
    start = BodyMotion(kinds, np.zeros(count), np.tril(square), pull, nothing, nothing)
    return start._solve(), square


def prior() -> Array:
    return np.diag([*np.diag(KNOWN), *[0.8**-2.0] * 6])


def test_amplitudes_are_those_of_what_was_seen_and_of_the_prior() -> None:
    motion, square = seen()
    truth = np.linalg.inv(square + prior())
    whitened = motion.whiten(np.eye(len(truth)))
    np.testing.assert_allclose(whitened.T @ whitened, truth, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(motion.amplitudes, truth @ motion.vector, rtol=1e-8, atol=1e-12)


def test_the_evidence_is_that_of_data_with_the_prior_integrated_out() -> None:
    motion, square = seen()
    root = np.linalg.cholesky(np.linalg.inv(prior()))
    truth = LinearGaussianSystem(square, motion.vector).project(root).log_evidence(1.0)
    assert motion.log_evidence == pytest.approx(float(truth))


def written_out(motion: BodyMotion, pair: int, *, from_middle: bool) -> Array:
    """(C, 12) field after field and course after course."""
    total = np.zeros((CELLS, 12))
    place = 0
    for kind in motion.kinds:
        for field in range(kind.fields.shape[2]):
            for course in range(kind.modes.count):
                along = kind.modes.values[pair, course]
                along -= kind.modes.middle[course] if from_middle else 0.0
                total += motion.amplitudes[place] * along * kind.fields[:, :, field]
                place += 1
    return total


@pytest.mark.parametrize("from_middle", [False, True])
def test_displacements_are_fields_times_courses(from_middle: bool) -> None:
    motion, _ = seen()
    found = motion.displacements(["pose", "parts"], from_middle=from_middle)
    for pair in range(PAIRS):
        truth = written_out(motion, pair, from_middle=from_middle)
        np.testing.assert_allclose(found[pair], truth, atol=1e-12)
    alone = motion.displacements(["parts"], from_middle=from_middle)
    assert np.abs(alone - found).max() > 0.1
    # Of each amplitude, as a pair saw the cells.
    rows = motion.observation_matrix(1, np.array([2, 0]), NORMALS[[2, 0]])
    told = written_out(motion, 1, from_middle=True)
    along = np.sum(told[[2, 0], :3] * NORMALS[[2, 0]], axis=1)
    np.testing.assert_allclose(rows @ motion.amplitudes, along, atol=1e-12)


def test_a_pairs_placing_and_bends_make_up_all_displacements() -> None:
    """Of a body that leans the placing takes all along, and bends leave its feet behind."""
    heights = np.array([20.0, 60.0, 110.0, 900.0, 1700.0])
    centres = np.stack([[100.0, -40.0, 30.0, 0.0, 20.0], np.zeros(5), heights], axis=1)
    links = sparse.csr_array((5, 5))
    cells = BodyCells(centres, np.tile([1.0, 0, 0], (5, 1)), links, np.arange(5), np.eye(5))
    kinds = build_kinds(cells, [0.0, 0.7], 0.35, np.diag(1.0 / np.diag(KNOWN)), np.ones(6))
    pose, lean = kinds[:2]
    motion, _ = seen((pose, lean))
    for from_middle in (False, True):
        every = motion.displacements(("pose", "lean"), from_middle=from_middle)
        bends = motion.non_rigid(from_middle=from_middle)
        for pair in range(PAIRS):
            turn, shift = motion.twist(pair, from_middle=from_middle).reshape(2, 3)
            placed = np.cross(turn, centres) + shift
            np.testing.assert_allclose(every[pair, :, :3], placed + bends[pair, :, :3], atol=1e-9)
    beside, _ = seen((replace(POSE, twists=np.eye(6)), PARTS))
    np.testing.assert_array_equal(beside.non_rigid(), beside.displacements(("parts",)))
    # The foot stays; the ankle and what is above go about it, a metre up by a millimetre.
    np.testing.assert_allclose(lean.fields[0, :3], 0.0, atol=1e-12)
    ankle = find_ankles(cells)
    np.testing.assert_allclose(ankle, [30.0, 0.0, 0.05 * 1700.0])
    for k, axis in enumerate(np.eye(3)):
        about = np.cross(axis, centres[2:] - ankle) / 1000.0
        np.testing.assert_allclose(lean.fields[2:, :3, k], about, atol=1e-12)
    assert lean.fields[4, 0, 1] == pytest.approx(1.615)


def test_a_kind_is_as_large_as_the_evidence_and_people_say() -> None:
    """MacKay's: amplitudes over as many of them as were told, and six of the usual size."""
    motion, _ = seen()
    told = 6.0 - np.sum(motion.variances[12:]) / 0.8**2
    size = np.sqrt((np.sum(motion.amplitudes[12:] ** 2) + 6.0) / (told + 6.0))
    pose, parts = motion._update_prior_variances().kinds
    assert parts.size == pytest.approx(size)
    assert pose is POSE, "what boards left open is no motion of the person"


def test_a_breath_is_asked_of_what_other_motions_leave() -> None:
    """And what it is believed to be takes its prior's place."""
    alike = np.array([[1.3, 0.2], [0.2, 0.6]])
    prior: Array = np.asarray(np.kron(np.eye(3), np.linalg.inv(alike)))
    breath = MotionKind("breath", PARTS.fields, COURSES, precision=prior)
    motion, square = seen((POSE, breath))
    asked = []

    def believe(system: LinearGaussianSystem, breaths: Breaths, middle: Array) -> BreathEstimate:
        asked.append((system.information, system.vector, middle))
        return BreathEstimate(4.0 * alike, np.zeros(3), np.eye(3))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(body_motion, "estimate_breath", believe)
        found = motion._estimate_breath()
    [(information, pull, middle)] = asked
    rest = np.linalg.inv(square[:12, :12] + KNOWN)
    np.testing.assert_allclose(
        information, square[12:, 12:] - square[12:, :12] @ rest @ square[:12, 12:], atol=1e-7
    )
    np.testing.assert_allclose(
        pull, motion.vector[12:] - square[12:, :12] @ rest @ motion.vector[:12], atol=1e-7
    )
    np.testing.assert_array_equal(middle, COURSES.middle)
    assert found.breath is not None
    np.testing.assert_allclose(found.kind("breath").prior_information, prior / 4.0, atol=1e-12)
    assert found._update_prior_variances().kind("breath") is found.kind("breath")


def test_what_is_asked_of_poses_is_what_any_motion_leaves() -> None:
    """The least misfit of all motions, with each pair moved besides: its slope and its bend."""
    motion, square = seen()
    system = motion.pose_equations()
    information, pull = system.information, system.vector
    order = np.arange(12).reshape(6, PAIRS).T.ravel()  # of amplitudes, pair after pair

    def misfit(moved: Array) -> float:
        besides = np.zeros(COUNT)
        besides[order] = moved
        right = motion.vector - square @ besides
        left = np.linalg.solve(square + prior(), right)
        both = left + besides
        return float(
            0.5 * both @ square @ both - motion.vector @ both + 0.5 * left @ prior() @ left
        )

    step = 1e-3 * np.eye(12)
    slope = [(misfit(one) - misfit(-one)) / 2e-3 for one in step]
    np.testing.assert_allclose(slope, -pull, atol=1e-6 * np.abs(pull).max())
    bend = [(misfit(one) + misfit(-one) - 2.0 * misfit(0.0 * one)) / 1e-6 for one in step]
    np.testing.assert_allclose(bend, np.diag(information), rtol=1e-3)
    mixed = (misfit(step[0] + step[7]) - misfit(step[0] - step[7])) / 2.0 / 1e-6
    mixed -= slope[7] / 1e-3
    assert mixed == pytest.approx(information[0, 7], rel=1e-2, abs=1e-3)


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
    """Errors of many cells cancel around a girth, one of them all does not; few turn as far as many."""
    centres = np.repeat([[0.0, 0.0, 1000.0], [0.0, 0.0, 1200.0]], 100, axis=0)
    quarters = np.tile(np.repeat([0, 1, 2, 3], [40, 10, 40, 10]), 2)
    normals = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])[quarters]
    for errors, sigma in ((normals**0, 3.0**0.5), (np.eye(200), 0.125), (normals**2, 0.5**0.5)):
        found = compute_girth_sigmas(errors, centres, normals)
        np.testing.assert_allclose(found, sigma, rtol=1e-5)


def test_a_place_that_two_saw_alike_is_as_uncertain_as_one_and_one_that_errs_by_itself_less(
    cells: BodyCells,
) -> None:
    """Pairs' own errors average out over those who saw a place."""
    boards = np.diag(np.tile([1e-12] * 3 + [0.1**2] * 3, 4))
    rest = BodyMotion.at_rest(cells, [0.0, 0.0, 0.0, 0.0], 0.0, boards, np.full(6, 1e-3))
    pose, *others = rest.kinds
    known = (replace(kind, precision=1e8 * np.eye(kind.count)) for kind in others)
    motion = replace(rest, kinds=(pose, *known))._solve()
    seen = np.zeros((4, len(cells.centres)), bool)
    left = cells.centres[:, 1] > 0.0
    seen[0, left], seen[1, ~left] = True, True
    once, girth = compute_shape_sigmas(motion, cells, seen)
    seen[2, left], seen[3, ~left] = True, True
    twice, _ = compute_shape_sigmas(motion, cells, seen)
    assert 0.0 < rms(girth) < rms(once)
    assert rms(twice) == pytest.approx(rms(once) / np.sqrt(2.0), rel=0.05)
