"""Range images of one body from several sides, pushed apart and brought together again."""

from typing import Literal

import numpy as np
import pytest
from living_body import known_to
from made_bodies import ellipsoid
from ray_cast_scan import Truth, cast_rays, scene_of
from ring import looking_at

from bodyscan.alignment.icp import Alignment, Overlap, align
from bodyscan.alignment.matching import Matches
from bodyscan.alignment.overlaps import linearize
from bodyscan.errors import FailedWork
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.motion.object_refinement import refine_on_object
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.triangulation import estimate_grid_normals
from bodyscan.settings import AlignmentSettings

CAMERA = Camera(380.0, 380.0, 0.0, 160.0, 128.0, Radial(), 320, 256)
NOISE_MM = 0.2


Scanned = tuple[list[RangeImage], dict[str, RigidTransform]]
"""Range images, and where their cameras stand."""


@pytest.fixture(scope="module")
def scanned() -> Scanned:
    """Four cameras at 90 degrees around a lumpy body (two ellipsoids), and their true placings."""
    points, faces = ellipsoid((110.0, 170.0, 300.0), resolution=120)
    points[:, 0] += 25.0 * np.sin(points[:, 2] / 60.0)
    points[:, 1] += 30.0 * np.cos(points[:, 2] / 80.0 + 1.0)
    points[:, 2] += 900.0
    scene = scene_of(Truth(points, faces))
    rng = np.random.default_rng(3)
    images, placings = [], {}
    for k, angle in enumerate(np.radians([20.0, 110.0, 200.0, 290.0])):
        name = f"p{k}"
        place = looking_at(
            [1300.0 * np.cos(angle), 1300.0 * np.sin(angle), 950.0], [0.0, 0.0, 900.0]
        )
        rays = CAMERA.pixel_rays()
        depth = cast_rays(scene, place.translation, place.rotate(rays))["t_hit"].astype(float)
        depth = np.where(np.isfinite(depth), depth, np.nan) + rng.normal(0, NOISE_MM, depth.shape)
        seen = (rays * depth[..., None]).astype(np.float32)
        sigma = np.where(np.isfinite(depth), NOISE_MM, np.nan).astype(np.float32)
        grey = np.full(depth.shape, 150, np.uint8)
        images.append(RangeImage(name, CAMERA, seen, estimate_grid_normals(seen), sigma, grey))
        placings[name] = place
    return images, placings


def pushed(
    placings: dict[str, RigidTransform], mm: float, seed: int = 0
) -> dict[str, RigidTransform]:
    rng = np.random.default_rng(seed)
    away = {}
    for name, placing in placings.items():
        shift = rng.normal(0.0, mm, 3)
        away[name] = RigidTransform(placing.rotation, placing.translation + shift)
    return away


def disagreement_mm(placings: dict[str, RigidTransform], truth: dict[str, RigidTransform]) -> float:
    """RMS distance between where pairs put a point of the body, the common motion taken out."""
    point = np.array([0.0, 0.0, 900.0])
    moved = [(placings[n] @ truth[n].inverse()).apply(point) - point for n in placings]
    return float(np.sqrt(np.mean(np.sum((moved - np.mean(moved, axis=0)) ** 2, axis=1))))


@pytest.mark.parametrize("matching", ["projected", "open3d"])
def test_pairs_come_together(scanned: Scanned, matching: Literal["projected", "open3d"]) -> None:
    images, truth = scanned
    start = pushed(truth, 1.5)
    settings = AlignmentSettings(matching=matching, sway_mm=0.0, sway_deg=0.0)
    found = align(images, start, known_to(truth, 1.5, 0.02), settings)
    assert disagreement_mm(start, truth) > 1.0
    # Thousands of matches of 0.3 mm each; what is left is curvature seen through pixels of 3.4 mm.
    assert disagreement_mm(found.rig_from_camera, truth) < 0.3
    assert found.rms_after_mm < found.rms_before_mm


def test_a_firm_prior_is_not_moved(scanned: Scanned) -> None:
    images, truth = scanned
    settings = AlignmentSettings(sway_mm=0.0, sway_deg=0.0)
    found = align(images, truth, known_to(truth, 0.01, 0.001), settings)
    assert max(found.motion_mm.values()) < 0.1


def test_a_pair_that_asks_for_too_much_stays(scanned: Scanned) -> None:
    images, truth = scanned
    start = dict(truth)
    start["p2"] = RigidTransform(
        truth["p2"].rotation, truth["p2"].translation + np.array([4.0, -4.0, 5.0])
    )
    settings = AlignmentSettings(sway_mm=0.0, sway_deg=0.0, limit_sigmas=3.0)
    found = align(images, start, known_to(truth, 0.3, 0.005), settings)
    assert "p2" in found.refused
    assert np.allclose(found.rig_from_camera["p2"].matrix, start["p2"].matrix)


def test_a_pair_without_overlap_stays(scanned: Scanned) -> None:
    images, truth = scanned
    alone = [image for image in images if image.pair in ("p0", "p2")]
    two = {name: truth[name] for name in ("p0", "p2")}
    found = align(alone, two, known_to(two, 1.0, 0.02), AlignmentSettings())
    assert not found.overlaps
    assert not found.motion_mm  # nobody saw whether they moved
    assert np.allclose(found.rig_from_camera["p2"].matrix, two["p2"].matrix)


@pytest.mark.parametrize("sway_mm", [0.0, 1.0, 3.0])
def test_sway_is_found_whatever_its_size(scanned: Scanned, sway_mm: float) -> None:
    """The settings know of 1 mm; a person who stands still or sways by far more is as well aligned."""
    images, truth = scanned
    rng = np.random.default_rng(7)
    start = {
        name: t.retract([*rng.normal(0.0, 1e-4 * sway_mm, 3), *rng.normal(0.0, sway_mm, 3)])
        for name, t in truth.items()
    }
    found = align(images, start, known_to(truth, 0.02, 0.001), AlignmentSettings())
    # Noise of 0.2 mm on pixels of 3.4 mm; a fixed prior of 1 mm leaves 0.5 mm of the 3.
    assert disagreement_mm(found.rig_from_camera, truth) < 0.25
    assert not found.refused
    if sway_mm:
        assert max(found.motion_mm.values()) > 0.5 * sway_mm
    else:
        assert max(found.motion_mm.values()) < 0.3


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_rig_is_refined_on_a_still_object(scanned: Scanned) -> None:
    images, truth = scanned
    start = pushed(truth, 0.8, seed=2) | {"unseen": truth["p0"]}
    prior = known_to(start, 0.8, 0.02)
    refined = refine_on_object(images, start, prior, {})
    assert refined.better
    assert disagreement_mm({n: refined.rig_from_camera[n] for n in truth}, truth) < 0.3
    assert refined.rig_from_camera["unseen"] is start["unseen"]
    assert "mm RMS before" in refined.lines[0]
    with pytest.raises(FailedWork, match="no two pairs"):
        refine_on_object([i for i in images if i.pair in ("p0", "p2")], start, prior, {})


@pytest.mark.slow
@pytest.mark.parametrize("matching", ["projected", "open3d"])
def test_threads_change_nothing(
    scanned: Scanned, matching: Literal["projected", "open3d"], monkeypatch: pytest.MonkeyPatch
) -> None:
    images, truth = scanned
    start, prior = pushed(truth, 1.5), known_to(truth, 1.5, 0.02)
    settings = AlignmentSettings(matching=matching)
    one = align(images, start, prior, settings)
    monkeypatch.setattr(map_threads, "__kwdefaults__", {"workers": 3})
    many = align(images, start, prior, settings)
    for name in truth:
        np.testing.assert_array_equal(
            one.rig_from_camera[name].matrix, many.rig_from_camera[name].matrix
        )
    assert repr(one.overlaps) == repr(many.overlaps)  # NaN is equal in text alone


def test_the_normal_equations_are_those_of_the_distances_jacobian() -> None:
    """By numerical derivative: a small motion of the source changes distances along the normals."""
    rng = np.random.default_rng(5)
    points, normals = rng.uniform(-300.0, 300.0, (200, 3)), rng.standard_normal((200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    matches = Matches(
        points, normals, rng.normal(0.0, 0.5, 200), rng.uniform(0.1, 0.3, 200), np.arange(200)
    )
    jacobian = np.empty((200, 6))
    for k, step in enumerate(1e-6 * np.eye(6)):
        moved = RigidTransform.identity().retract(step).apply(points)
        jacobian[:, k] = np.sum((moved - points) * normals, axis=1) / 1e-6
    spread = 1.4826 * np.median(np.abs(matches.distances))
    sigma = np.hypot(matches.sigma_mm, spread)
    weights = 1.0 / (1.0 + (matches.distances / (2.0 * sigma)) ** 2) / (sigma**2 * 5.0)
    found = linearize(matches, correlated=5.0)
    scale = np.sqrt(np.diag(found.information))  # rotations of 300 mm arms beside millimetres
    information = jacobian.T @ (weights[:, None] * jacobian)
    np.testing.assert_allclose(
        found.information / np.outer(scale, scale), information / np.outer(scale, scale), atol=1e-5
    )
    gradient = jacobian.T @ (weights * matches.distances)
    np.testing.assert_allclose(-found.vector / scale, gradient / scale, atol=1e-4)


def test_distances_of_all_overlaps_count_by_their_points() -> None:
    def of(*overlaps: Overlap) -> Alignment:
        return Alignment({}, {}, {}, overlaps)

    found = of(Overlap("a", "b", 300, 0.4, 0.2, 0.1), Overlap("b", "c", 100, 0.8, 0.6))
    assert found.rms_before_mm == pytest.approx(np.sqrt((3 * 0.16 + 0.64) / 4.0))
    assert found.rms_after_mm == pytest.approx(np.sqrt((3 * 0.04 + 0.36) / 4.0))
    # What noise would make of the second is not known.
    assert found.expected_mm == pytest.approx(0.1)
    assert np.isnan(of().rms_after_mm)
