"""What explains a scan better than a person's motion, of evidence drawn from what is believed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyscan.alignment.displaced_poles import DisplacedPole
from bodyscan.alignment.pose_evidence import (
    CommonError,
    Displacement,
    PoseEvidence,
    ScaleError,
    build_common_basis,
    detect_displacement,
)
from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform

NAMES = tuple(f"p{pole}-{k}" for pole in (1, 2, 3) for k in (1, 2, 3, 4))
POLES = {name: name[:2] for name in NAMES}
ROUND = {f"p{k}": 2.0 * np.pi * k / 3.0 for k in (1, 2, 3)}
OUT = np.array([[np.cos(ROUND[POLES[n]]), np.sin(ROUND[POLES[n]]), 0.0] for n in NAMES])
HEIGHTS = 500.0 * np.array([int(name[-1]) for name in NAMES])
PLACED = {
    name: RigidTransform(np.eye(3), 1300.0 * out + [0.0, 0.0, height])
    for name, out, height in zip(NAMES, OUT, HEIGHTS, strict=True)
}
SIGMA_MM = 0.3
"""By which a pair's motion along each axis is known, against the mean of all."""


def evidence(shifts: Array, seed: int = 0, noise: float = 1.0) -> PoseEvidence:
    """shifts: (P, 3) mm of the body's centre; what all have in common is not seen. noise: in sigmas."""
    count = len(NAMES)
    rng = np.random.default_rng(seed)
    seen = np.eye(count) - np.ones((count, count)) / count
    centred = np.eye(6)
    centred[:3, 3:] = np.cross(np.eye(3), BODY_CENTRE)
    units = centred @ np.diag(np.repeat([400.0**2, 1.0], 3)) @ centred.T / SIGMA_MM**2
    information = np.kron(seen, units).astype(float)
    sizes, ways = np.linalg.eigh(information)
    root = (ways * np.sqrt(np.maximum(sizes, 0.0))) @ ways.T  # the same on every processor
    astray = noise * root @ rng.standard_normal(len(sizes))
    twists = np.hstack([np.zeros((count, 3)), shifts]).ravel()
    return PoseEvidence(NAMES, LinearGaussianSystem(information, information @ twists + astray))


def off(shifts: Array, seed: int = 0, displaced: tuple[str, ...] = ()) -> Any:
    return detect_displacement(evidence(shifts, seed), PLACED, POLES, displaced)


def of_pole(pole: str, shift: list[float]) -> Array:
    return np.array([shift if POLES[name] == pole else [0.0] * 3 for name in NAMES])


def of_pair(pair: str, shift: list[float]) -> Array:
    return np.array([shift if name == pair else [0.0] * 3 for name in NAMES])


def test_noise_is_nothing() -> None:
    assert not any(off(0.0 * OUT, seed) for seed in range(50))


@pytest.mark.parametrize("out_mm", [-3.0, -1.0, 1.0, 3.0])
def test_poles_that_all_stand_off_alike_are_a_size(out_mm: float) -> None:
    for seed in range(10):
        found = off(out_mm * OUT, seed)
        assert isinstance(found, ScaleError)
        assert abs(found.outward_mm - out_mm) < 4.0 * found.sigma_mm < 0.5


@pytest.mark.parametrize("freedom", [0, 1, 3, 4])
def test_one_change_of_all_pairs_is_asked_for_before_any_pole(freedom: int) -> None:
    """All principal points off by 0.3 px were six pairs that moved by themselves."""
    placed = {}
    for name, out, height in zip(NAMES, OUT, HEIGHTS, strict=True):
        right = np.array([-out[1], out[0], 0.0])
        forward = -out - [0.0, 0.0, 0.001 * (height - 1000.0)]
        forward /= np.linalg.norm(forward)
        axes = np.stack([right, np.cross(forward, right), forward], axis=1)
        placed[name] = RigidTransform(axes, PLACED[name].translation)
    moved, sound = 2.0 * build_common_basis(NAMES, placed)[:, freedom], evidence(0.0 * OUT).system
    vector = sound.vector + sound.information @ moved
    off = PoseEvidence(NAMES, LinearGaussianSystem(sound.information, vector))
    found = detect_displacement(off, placed, POLES)
    assert isinstance(found, CommonError)
    expected = (0.0, np.degrees(2.0 / 400.0)) if freedom > 2 else (2.0, 0.0)
    assert (found.shift_mm, found.rotation_deg) == pytest.approx(expected, abs=0.9)
    # Unless something else explains it better.
    assert not detect_displacement(PoseEvidence(NAMES, off.system, {}, ("", 1e6)), placed, POLES)


@pytest.mark.parametrize("pole", ["p1", "p2", "p3"])
def test_one_pole_that_moved_is_named(pole: str) -> None:
    for seed in range(10):
        found = off(of_pole(pole, [3.0, 2.0, 1.0]), seed)
        assert (found.name, found.all_moved, found.certain) == (f"pole {pole}", False, True)
        assert found.shift_mm == pytest.approx(np.sqrt(14.0), abs=1.0)
        assert found.rotation_deg < 0.2


def test_a_pole_that_may_have_moved_is_freed_and_not_named() -> None:
    for shifts, name in ((of_pole("p1", [0.0, 1.0, 0.0]), "pole p1"), (0.4 * OUT, "")):
        found: Any = detect_displacement(evidence(shifts, noise=0.0), PLACED, POLES)
        assert (getattr(found, "name", ""), found.certain) == (name, False)
    assert off(of_pole("p1", [0.0, 1.0, 0.0]), displaced=("p3-1",)) is None
    # All out explains this a little better, 21.5 to 17.4.
    assert off(0.3 * OUT + of_pole("p2", (0.9 * OUT[4]).tolist())).name == "pole p2"


@pytest.mark.parametrize("pair", ["p1-1", "p2-3", "p3-4"])
def test_one_pair_that_moved_is_named_and_not_its_pole(pair: str) -> None:
    """5 mm of it were taken for 1 mm of its pole, and the scan for usable."""
    for seed in range(5):
        found = off(of_pair(pair, [5.0, 0.0, 0.0]), seed)
        assert (found.name, found.pairs) == (f"pair {pair}", frozenset({pair}))
        assert found.shift_mm == pytest.approx(5.0, abs=1.0)  # three of its sigmas


def test_another_pair_than_those_that_are_free() -> None:
    shifts = of_pair("p1-1", [5.0, 0.0, 0.0]) + of_pair("p3-2", [0.0, 4.0, 0.0])
    assert off(shifts, displaced=("p1-1",)).name == "pair p3-2"


def of_few(whole: PoseEvidence, *names: str) -> Displacement | None:
    """What is found if there are these pairs alone."""
    places = np.concatenate([6 * NAMES.index(name) + np.arange(6) for name in names])
    return detect_displacement(PoseEvidence(names, whole.system.select(places)), PLACED, POLES)


def test_of_three_pairs_any_may_have_moved() -> None:
    found = of_few(evidence(of_pair("p1-1", [5.0, 0.0, 0.0])), "p1-1", "p2-1", "p3-1")
    assert not isinstance(found, DisplacedPole) or found.all_moved


def test_poles_that_moved_each_its_own_way_leave_none_to_go_by() -> None:
    shifts = of_pole("p1", [3.0, 2.0, 0.0]) + of_pole("p2", [-2.0, 3.0, 2.0])
    found = off(shifts + of_pole("p3", [-1.0, -4.0, -1.0]))
    assert found.all_moved


def test_less_than_does_harm_is_not_said() -> None:
    """However well it is known: calibrations of poles disagree by as much."""
    assert off(of_pole("p1", [0.5, 0.0, 0.0])) is None
    assert off(0.2 * OUT) is None


def test_of_poles_that_are_free_nothing_is_asked() -> None:
    displaced = tuple(name for name in NAMES if POLES[name] == "p2")
    assert off(of_pole("p3", [0.0, 5.0, 0.0]), displaced=displaced).name == "pole p3"
    assert not isinstance(off(3.0 * OUT, displaced=displaced), ScaleError)
    assert off(of_pole("p2", [0.0, 5.0, 0.0]), displaced=NAMES) is None


def test_of_three_pairs_two_that_stand_on_one_pole_and_moved_are_named() -> None:
    # Which of two sides moved, or both, only noise would decide.
    found = of_few(evidence(of_pole("p1", [5.0, 0.0, 0.0]), noise=0.0), "p1-1", "p1-3", "p2-1")
    assert isinstance(found, DisplacedPole)
    assert (found.name, sorted(found.pairs)) == ("pole p1", ["p1-1", "p1-3"])


def test_overlaps_known_ten_times_better_show_a_smaller_displacement() -> None:
    for shifts in (of_pole("p2", [0.0, 0.6, 0.0]), of_pair("p1-2", [0.6, 0.0, 0.0])):
        fine = PoseEvidence(NAMES, evidence(shifts, noise=0.1).system * 100.0)
        found = detect_displacement(fine, PLACED, POLES)
        assert isinstance(found, DisplacedPole)
        assert found.size_mm == pytest.approx(0.6, abs=0.12)  # three sigmas of a single pair
