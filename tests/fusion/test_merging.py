"""The merged cloud of a body against the truth, and what becomes of misplaced pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ray_cast_scan import Scan, scene_of
from scipy.spatial import cKDTree

from bodyscan.arrays import Array
from bodyscan.errors import ScanFailed
from bodyscan.evaluation.surface import (
    compute_signed_distances,
    find_covered_spots,
    sample_surface,
    summarize_deviation,
)
from bodyscan.fusion.merging import merge
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import FusionSettings

SETTINGS = FusionSettings(points=250_000)


@pytest.fixture(scope="module")
def off(scan: Scan, cloud: BodyCloud) -> Array:
    """How far off the body each point of the cloud is, mm."""
    return compute_signed_distances(cloud.points, scan.truth.vertices, scan.truth.faces)


def test_the_cloud_lies_on_the_body(off: Array) -> None:
    """The targets for full-size images; here there are four times fewer pixels to average."""
    found = summarize_deviation(off)
    assert abs(found.bias_mm) < 0.03
    assert found.rms_mm < 0.15
    assert found.p95_mm < 0.30
    # Nothing far off: flying pixels are gone. Ears and lips are smaller than the window.
    assert found.worst_mm < 5.0


def test_normals_look_outward(scan: Scan, cloud: BodyCloud) -> None:
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
    nearest = scene_of(scan.truth).compute_closest_points(cloud.points.astype(np.float32))
    cosine = np.sum(nearest["primitive_normals"].numpy() * cloud.normals, axis=1)
    assert np.mean(cosine > 0.9) > 0.99
    assert np.median(np.degrees(np.arccos(cosine.clip(-1, 1)))) < 2.0
    assert np.mean(cosine < 0.0) < 1e-4


def test_what_the_pairs_could_see_is_covered(scan: Scan, cloud: BodyCloud) -> None:
    """Against what is left when each pair's exact, uncleaned points are asked for."""
    exact = np.concatenate(
        [
            scan.rig_from_camera[image.pair].apply(image.points[image.valid].astype(float))
            for image in scan.range_images
        ]
    )
    truth = scan.truth
    body = exact[exact[:, 2] > 5.0]
    spots = sample_surface(truth.vertices, truth.faces, 40_000)
    possible = np.mean(find_covered_spots(body, *spots, 1.0, 3.0))
    found = np.mean(find_covered_spots(cloud.points, *spots, 1.0, 3.0))
    # Surfaces seen at more than 79 degrees, and rims, are given up.
    assert found > possible - 0.03
    assert found > 0.9


def test_sigma_is_honest(off: Array, cloud: BodyCloud) -> None:
    ratio = np.abs(off) / cloud.sigma_mm
    # 0.8 to 1.25 times 0.67, the median of a standard normal's size.
    assert 0.54 < np.median(ratio) < 0.84
    assert np.median(cloud.sigma_mm) < 0.1


def test_more_pairs_are_better(off: Array, cloud: BodyCloud) -> None:
    assert cloud.pairs_seen.min() >= 1
    assert 3 <= cloud.pairs_seen.max() <= 12
    alone, together = (np.median(np.abs(off[cloud.pairs_seen == n])) for n in (1, 3))
    assert together < 0.8 * alone


def test_the_same_images_give_the_same_bytes(
    scan: Scan, cleaned: list[RangeImage], cloud: BodyCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_threads, "__kwdefaults__", {"workers": 3})
    again = merge(cleaned, scan.rig_from_camera, SETTINGS).cloud
    assert again.regions is None  # which merging does not tell
    for name in ("points", "normals", "sigma_mm", "colours", "pairs_seen"):
        assert getattr(again, name).tobytes() == getattr(cloud, name).tobytes()


def test_small_misalignments_are_averaged(scan: Scan, cleaned: list[RangeImage]) -> None:
    """Pairs off by 0.2 mm and 0.1 mrad, as calibration leaves them: no double surface."""
    rng = np.random.default_rng(5)
    moved = {
        name: placing
        @ RigidTransform.from_rotation_vector(rng.normal(0, 1e-4, 3), rng.normal(0, 0.2, 3))
        for name, placing in scan.rig_from_camera.items()
    }
    cloud = merge(cleaned, moved, SETTINGS).cloud
    off = compute_signed_distances(cloud.points, scan.truth.vertices, scan.truth.faces)
    # 0.2 mm and 0.1 mrad times 1.3 m are 0.24 mm along the normal where one pair sees alone.
    assert summarize_deviation(off).rms_mm < 0.3
    # Disagreement between pairs shows in sigma.
    assert 0.54 < np.median(np.abs(off) / cloud.sigma_mm) < 0.84
    assert _share_of_doubles(cloud, off, 0.6) < 0.01


def test_a_misplaced_pair_leaves_no_double_surface(scan: Scan, cleaned: list[RangeImage]) -> None:
    """One pair 3 mm too far: where others see the same, one of the surfaces has to go."""
    shift = RigidTransform(np.eye(3), np.array([0.0, 0.0, 3.0]))
    moved = {**scan.rig_from_camera, "p1-2": scan.rig_from_camera["p1-2"] @ shift}
    cloud = merge(cleaned, moved, SETTINGS).cloud
    off = compute_signed_distances(cloud.points, scan.truth.vertices, scan.truth.faces)
    assert np.mean(np.abs(off) > 1.5) > 0.02  # what only that pair saw
    assert _share_of_doubles(cloud, off, 1.5) < 0.01


def _share_of_doubles(cloud: BodyCloud, off: np.ndarray, apart_mm: float) -> float:
    """Of points off by more than `apart_mm`: those with several right ones within 3 mm."""
    right, wrong = np.abs(off) < apart_mm / 2, np.abs(off) > apart_mm
    distance = np.asarray(cKDTree(cloud.points[right]).query(cloud.points[wrong], k=4)[0])
    return float(np.sum(distance[:, -1] < 3.0) / len(cloud.points))


def test_points_in_front_of_what_others_see_go(scan: Scan, cleaned: list[RangeImage]) -> None:
    """A patch that one pair puts 40 mm in front of the chest while others see the chest."""
    number = next(k for k, image in enumerate(cleaned) if image.pair == "p1-3")
    image = cleaned[number]
    points = image.points.copy()
    rows, columns = np.nonzero(image.valid)
    middle = (int(np.median(rows)), int(np.median(columns)))
    patch = np.s_[middle[0] - 12 : middle[0] + 12, middle[1] - 12 : middle[1] + 12]
    points[patch] *= 1.0 - 40.0 / np.linalg.norm(points[patch], axis=-1, keepdims=True)
    wrong = RangeImage(
        image.pair, image.camera, points, image.normals, image.sigma_mm, image.colours
    )
    images = [*cleaned[:number], wrong, *cleaned[number + 1 :]]
    cloud = merge(images, scan.rig_from_camera, SETTINGS).cloud
    patched = points[patch].reshape(-1, 3)
    floating = scan.rig_from_camera["p1-3"].apply(patched[np.isfinite(patched[:, 0])].astype(float))
    assert len(floating) > 400
    distance, _ = cKDTree(cloud.points).query(floating)
    # Outvoted, but for a few that others look past only at the rims of what they see.
    assert np.mean(distance < 3.0) < 0.05


def test_nothing_to_merge_is_an_error(scan: Scan, cleaned: list[RangeImage]) -> None:
    nothing = np.full_like(cleaned[0].sigma_mm, np.nan)
    image = replace(cleaned[0], sigma_mm=nothing)
    for images in ([], [image]):
        with pytest.raises(ScanFailed, match="next to nothing"):
            merge(images, scan.rig_from_camera, SETTINGS)


def test_few_points_are_all_kept(scan: Scan, cleaned: list[RangeImage]) -> None:
    image = cleaned[3]
    cloud = merge([image], scan.rig_from_camera, FusionSettings(points=10_000_000)).cloud
    assert 0.9 * image.valid.sum() < len(cloud.points) <= image.valid.sum()
    assert (cloud.pairs_seen == 1).all()
