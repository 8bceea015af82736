"""A pole that does not belong: moved, from another scan, of another person. No cloud, no mesh: range
images at a third of the size (a pixel is 2 mm), aligned and judged as `fuse` does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from ray_cast_scan import BODY, cast_scan, load_body, load_rig, nominal_placings

from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.matching import Matches
from bodyscan.arrays import Array
from bodyscan.fusion.cleaning import clean
from bodyscan.fusion.verdict.evidence import Seam, SeamReport
from bodyscan.fusion.verdict.overlaps import (
    compute_patch_medians,
    estimate_step,
    find_misaligned,
    find_seams,
)
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings

RIG = load_rig()
PLACED = nominal_placings(RIG)
AXIS = RigidTransform(np.eye(3), np.array([0.0, 0.0, 900.0]))
LIMIT_MM = 2.0 / (2.0 * np.pi)  # 2 mm of girth


@pytest.fixture(scope="module")
def woman() -> list[RangeImage]:
    return cast_scan(load_body(subdivisions=1), RIG, scale=0.35, noise_mm=0.1).range_images


@pytest.fixture(scope="module")
def man() -> list[RangeImage]:
    body = load_body(BODY.with_name("man_average.ply"), subdivisions=1)
    return cast_scan(body, RIG, scale=0.35, noise_mm=0.1, seed=2).range_images


def moved(pole: str, shift: Array, turn_deg: Array) -> dict[str, RigidTransform]:
    by = AXIS @ RigidTransform.from_rotation_vector(np.radians(turn_deg), shift) @ AXIS.inverse()
    return {name: by @ at if name.startswith(pole) else at for name, at in PLACED.items()}


def judged(
    images: list[RangeImage], placed: Mapping[str, RigidTransform] = PLACED
) -> tuple[SeamReport, Alignment]:
    sigmas = np.tile([2e-5] * 3 + [0.05] * 3, len(placed))
    covariance = PoseCovariance(tuple(placed), np.diag(sigmas**2))
    seen = [image for image in clean(images, dict(placed), RIG.volume) if image.valid.any()]
    aligned = align(seen, placed, covariance, AlignmentSettings())
    return find_seams(seen, aligned.rig_from_camera, RIG.poles), aligned


def said(report: SeamReport) -> dict[str, float]:
    found = find_misaligned(report.seams, report.groups, LIMIT_MM)
    return {misfit.name: misfit.step_mm for misfit in found}


def test_what_belongs_together_fits(woman: list[RangeImage]) -> None:
    report, aligned = judged(woman)
    assert not said(report)
    assert not report.isolated
    # Pole 2 shares hardly more than rims with the others: they tie it.
    assert set(aligned.motion_mm) == set(PLACED)


def test_a_person_who_sways_still_fits(woman: list[RangeImage]) -> None:
    rng = np.random.default_rng(4)
    shifts = {name: rng.normal(0.0, 2.0, 3) for name in PLACED}
    placed = {n: RigidTransform(t.rotation, t.translation + shifts[n]) for n, t in PLACED.items()}
    report, _ = judged(woman, placed)
    assert not said(report)


def test_a_pole_off_by_little_is_brought_back(woman: list[RangeImage]) -> None:
    """Its rims tie it, so that alignment finds the 2 mm, and no step is left."""
    report, aligned = judged(woman, moved("p2", np.array([-2.0, 0.0, 0.0]), np.zeros(3)))
    apart = [
        aligned.rig_from_camera[name].translation - PLACED[name].translation
        for name in ("p1-2", "p2-2", "p3-2")
    ]
    assert np.linalg.norm(np.ptp(apart, axis=0)) < 0.5
    assert not said(report)


@pytest.mark.parametrize("pole", ["p1", "p2"])
@pytest.mark.parametrize(
    ("shift", "turn_deg"),
    [
        ([25.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, 25.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 4.0]),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 8.0]),
        ([0.0, 0.0, 0.0], [4.0, 4.0, 0.0]),
    ],
)
def test_a_pole_that_stands_wrong_is_named(
    woman: list[RangeImage], pole: str, shift: list[float], turn_deg: list[float]
) -> None:
    """Farther than alignment reaches: it is moved by it, or it is named and nothing else is."""
    report, aligned = judged(woman, moved(pole, np.array(shift), np.array(turn_deg)))
    found = said(report)
    if not found:
        assert max(aligned.motion_mm.values()) > 6.0
        return
    (name, step) = next(iter(found.items()))
    assert name == f"pole {pole}"
    assert len(found) == 1
    assert step > 1.0


def test_the_step_grows_with_the_fault(woman: list[RangeImage]) -> None:
    steps = [
        said(judged(woman, moved("p2", np.array([-mm, 0.0, 0.0]), np.zeros(3)))[0])["pole p2"]
        for mm in (15.0, 25.0, 40.0)
    ]
    # 60 degrees from the pole a shift outwards shows with half its size.
    assert np.allclose(steps, [7.5, 12.5, 20.0], rtol=0.15)


@pytest.mark.parametrize("pole", ["p1", "p2"])
def test_another_person_is_told(woman: list[RangeImage], man: list[RangeImage], pole: str) -> None:
    mixed = [m if w.pair.startswith(pole) else w for w, m in zip(woman, man, strict=True)]
    found = said(judged(mixed)[0])
    assert next(iter(found)) == f"pole {pole}"
    assert found[f"pole {pole}"] > 2.0


def test_what_shares_no_surface_is_not_tied(woman: list[RangeImage]) -> None:
    """The lowest and the highest pair of two poles: legs and head, nothing between."""
    two = {name: PLACED[name] for name in ("p1-1", "p2-4")}
    images = [image for image in woman if image.pair in two]
    report, aligned = judged(images, two)
    assert len(report.isolated) == 1
    assert not aligned.motion_mm


def seam(one: str, other: str, apart_mm: float, patches: int = 10) -> Seam:
    return Seam((one, other), np.full(patches, apart_mm), np.full(patches, 0.1))


SINGLE = {f"pair {name}": frozenset([name]) for name in ("a1", "a2", "b1", "b2", "c1", "c2")}
POLES = SINGLE | {f"pole {p}": frozenset([f"{p}1", f"{p}2"]) for p in "abc"}


def test_the_fewest_pairs_that_explain_the_steps_are_named() -> None:
    fits = [
        seam("a1", "a2", 0.0),
        seam("b1", "b2", 0.0),
        seam("c1", "c2", 0.0),
        seam("b1", "c1", 0),
    ]
    pole = [*fits, seam("a1", "b1", 3.0), seam("a2", "c2", 2.0)]
    (found,) = find_misaligned(pole, POLES, LIMIT_MM)
    assert found.name == "pole a"
    assert found.step_mm == pytest.approx(3.0, abs=0.1)
    one = [*fits, seam("a1", "b1", 0.0), seam("b2", "a1", 3.0), seam("b2", "c2", 3.0, 30)]
    assert [misfit.name for misfit in find_misaligned(one, POLES, LIMIT_MM)] == ["pair b2"]


def test_noise_makes_no_step() -> None:
    """Medians that scatter as their sigmas say; three times as far they do not."""
    rng = np.random.default_rng(1)
    apart = np.abs(rng.normal(0.0, 0.6, 400))
    for sigma, steps in ((0.6, 0), (0.2, 1)):
        seams = [Seam(("a1", "b1"), apart, np.full(400, sigma))]
        assert len(find_misaligned(seams, POLES, LIMIT_MM)) == steps


def test_sigmas_of_patches_say_how_far_their_medians_scatter() -> None:
    """Of five neighbours each errs as one: 400 patches of 80 matches."""
    rng = np.random.default_rng(0)
    patch = np.repeat(np.arange(400), 80)
    apart = np.repeat(rng.standard_normal(400 * 16), 5) + 0.3
    points = np.column_stack([40.0 * (patch % 20) + 1.0, 40.0 * (patch // 20) + 39.0, 0.0 * patch])
    points[::2, :2] += [38.0, -38.0]
    found, sigma = compute_patch_medians(Matches(points, points, apart, apart, patch))
    assert len(found) == 400, "all 40 mm of a patch go together"
    # Medians of 16 scatter by 1.25 / 4; the robust sigma of so few is 5 % low.
    assert sigma.mean() == pytest.approx(1.2533 / 4.0, rel=0.1)
    assert np.mean(found) == pytest.approx(0.355, abs=0.03)  # of |0.3 +- 0.31|
    assert np.median(np.abs(found)) < 0.5


def test_a_step_is_what_three_of_four_patches_keep_to() -> None:
    apart = np.array([0.0, 1.0, 2.0, 3.0, 50.0])
    assert estimate_step([Seam(("a", "b"), apart, np.zeros(5))]) == pytest.approx(3.0)
    assert estimate_step([Seam(("a", "b"), apart, np.full(5, 2.0))]) == pytest.approx(np.sqrt(5.0))
    assert estimate_step([Seam(("a", "b"), apart, np.full(5, 4.0))]) == 0.0
