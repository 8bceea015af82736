"""What cleaning removes: the room, flying pixels, speckles and bridges over dark gaps."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from made_bodies import mesh_of
from ray_cast_scan import Scan, load_rig

from bodyscan.evaluation.surface import compute_signed_distances
from bodyscan.fusion.cleaning import (
    clean,
    cut_to_volume,
    drop_flying_pixels,
    drop_speckles,
    find_dark_gaps,
    find_foreground,
    find_inside,
)
from bodyscan.fusion.verdict.coverage import measure_coverage
from bodyscan.reconstruction.range_image import RangeImage

NOISE_MM = 0.3


def distances(scan: Scan, images: list[RangeImage]) -> np.ndarray:
    points = [
        scan.rig_from_camera[i.pair].apply(i.points[i.valid][::15].astype(float)) for i in images
    ]
    return np.abs(
        compute_signed_distances(np.concatenate(points), scan.truth.vertices, scan.truth.faces)
    )


def test_floor_and_flying_pixels_go_and_the_body_stays(
    scan: Scan, cleaned: list[RangeImage]
) -> None:
    before, after = distances(scan, scan.range_images), distances(scan, cleaned)
    body, kept = before < 6 * NOISE_MM, after < 6 * NOISE_MM
    # The scene holds a floor and about 1 % flying pixels.
    assert np.mean(~body) > 0.2
    # A flying pixel within a few millimetres of the surface cannot be told from it: 0.1 %.
    assert np.mean(~kept) < 1e-3
    assert after.max() < 15.0
    # Lost for good: rims of surfaces, and what is below the volume's 5 mm.
    assert kept.sum() > 0.95 * body.sum()


def test_inside_is_what_lies_in_the_cylinder(scan: Scan) -> None:
    volume = load_rig().volume
    for image in scan.range_images[2::3]:  # from every side, low and high
        placing = scan.rig_from_camera[image.pair]
        x, y, z = np.moveaxis(placing.apply(image.points.astype(float)), -1, 0)
        with np.errstate(invalid="ignore"):
            expected = np.hypot(x, y) < volume.radius_mm
            expected &= (z > volume.bottom_mm) & (z < volume.top_mm) & image.valid
        found = find_inside(image, placing, volume)
        assert 0.05 < found.mean() < 0.95
        assert np.count_nonzero(found != expected) <= 2  # rounding, right at the boundary
    nothing = replace(image, sigma_mm=np.full_like(image.sigma_mm, np.nan))
    assert not clean([nothing], scan.rig_from_camera, volume)[0].valid.any()


def test_pixels_stay_that_neighbours_agree_with() -> None:
    """Against a count of the neighbours of one pixel after the other."""
    rng = np.random.default_rng(8)
    depth = (1000.0 + 12.0 * rng.random((40, 50))).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    step_mm, supporters = 4.0, 11
    expected = depth
    for _ in range(2):
        padded, left = np.pad(expected, 2, constant_values=np.nan), np.full_like(depth, np.nan)
        for v, u in np.ndindex(depth.shape):
            off = np.abs(padded[v : v + 5, u : u + 5] - expected[v, u])
            limits = step_mm * np.hypot(*np.mgrid[-2:3, -2:3])
            if np.count_nonzero(off < limits) >= supporters:  # itself never: 0 < 0 is false
                left[v, u] = expected[v, u]
        expected = left
    found = drop_flying_pixels(depth, step_mm, supporters=supporters)
    assert 0.1 < np.isfinite(found).sum() / np.isfinite(depth).sum() < 0.9
    np.testing.assert_array_equal(found, expected)


def test_a_speckle_in_the_air_goes(scan: Scan, cleaned: list[RangeImage]) -> None:
    image = cleaned[6]
    rows, columns = slice(100, 106), slice(40, 46)
    assert not image.valid[rows, columns].any()
    points, sigma_mm, normals = image.points.copy(), image.sigma_mm.copy(), image.normals.copy()
    points[rows, columns] = 1300.0 * image.camera.pixel_rays()[rows, columns]
    sigma_mm[rows, columns], normals[rows, columns] = NOISE_MM, [0.0, 0.0, -1.0]
    image = replace(image, points=points, sigma_mm=sigma_mm, normals=normals)
    volume = load_rig().volume
    (strict,) = clean([image], scan.rig_from_camera, volume)
    # 36 pixels of 2.3 mm^2 are less than 150 mm^2, but more than 20 even without their rim.
    assert not strict.valid[rows, columns].any()
    (lenient,) = clean([image], scan.rig_from_camera, volume, smallest_patch_mm2=20.0)
    assert lenient.valid[rows, columns].sum() >= 12


def test_the_images_given_are_not_changed(scan: Scan, cleaned: list[RangeImage]) -> None:
    for before, after in zip(scan.range_images, cleaned, strict=True):
        assert before.pair == after.pair
        assert before.valid.sum() > after.valid.sum()
        kept = after.valid
        np.testing.assert_array_equal(after.points[kept], before.points[kept])
        np.testing.assert_array_equal(after.sigma_mm[kept], before.sigma_mm[kept])
        assert np.isnan(after.sigma_mm[~kept]).all()


def test_what_is_cut_to_the_volume_is_cleaned_and_checked_alike(
    scan: Scan, cleaned: list[RangeImage]
) -> None:
    volume, there = load_rig().volume, scan.rig_from_camera
    cut = [cut_to_volume(image, there[image.pair], volume) for image in scan.range_images]
    alike = clean(cut, there, volume)
    for one, other in zip(cleaned, alike, strict=True):
        np.testing.assert_array_equal(one.sigma_mm[other.part], other.sigma_mm)
        assert one.valid.sum() == other.valid.sum()
    vertices, faces = scan.truth.vertices, scan.truth.faces
    body = mesh_of(vertices, faces)
    checks = [measure_coverage(body, images, there) for images in (cleaned, alike)]
    assert len(checks[0].yields) == len(cleaned)
    assert checks[0].yields == checks[1].yields
    first = scan.range_images[0]
    behind = replace(first, points=first.points * np.float32(1.01))
    shown = [
        clean([some], there, volume, empty=[nobody])[0].valid.sum()
        for some, nobody in (
            (first, behind),
            (cut[0], cut_to_volume(behind, there[first.pair], volume)),
        )
    ]
    assert shown[0] == shown[1]
    assert shown[0] > 0


def test_a_rim_keeps_its_pixels_and_what_juts_out_of_it_goes() -> None:
    """A straight rim leaves 14 of 24 neighbours; 13 are enough."""
    depth = np.full((40, 40), 1000.0, np.float32)
    depth[:10] = np.nan
    assert np.isfinite(drop_flying_pixels(depth, 2.0)[10, 6:-6]).all()
    depth[12, 22] = np.nan
    assert np.isfinite(drop_flying_pixels(depth, 2.0)[10, 20])
    depth[12, 21] = np.nan
    assert np.isnan(drop_flying_pixels(depth, 2.0)[10, 20])


NAN = np.float32(np.nan)


@pytest.mark.parametrize(("patch", "kept"), [(49, 0), (51, 51)])
def test_patches_of_fewer_pixels_are_speckles(patch: int, kept: int) -> None:
    """A patch of so many pixels, a gap and a wall of 300."""
    depth = np.full((20, 30), NAN)
    depth[:, 15:] = 1000.0
    depth[np.divmod(np.arange(patch), 10)] = 1000.0
    found = drop_speckles(depth, 4.0, 50.0)
    assert found[:, :10].sum() == kept
    assert found[:, 15:].all()
    assert not found[:, 10:15].any(), "nothing was measured there"


@pytest.mark.parametrize("near_mm", [500.0, 2000.0, 7900.0])
@pytest.mark.parametrize(("jump_mm", "one"), [(3.75, True), (4.5, False)])
def test_a_jump_in_depth_parts_what_is_side_by_side(
    near_mm: float, jump_mm: float, one: bool
) -> None:
    """Depths are compared in quarters of a millimetre: two halves of 300 pixels each, or 600."""
    depth = np.full((20, 30), near_mm, np.float32)
    depth[:, 15:] += np.float32(jump_mm)
    found = drop_speckles(depth, 4.0, 400.0)
    assert found.all() if one else not found.any()


def test_what_stands_before_the_nearest_of_an_empty_rooms_pixels_around_is_no_background() -> None:
    room = np.full((9, 11), 3000.0, np.float32)
    room[4, 5] = 2000.0  # the edge of a shelf
    room[0, 0] = 0.0  # nothing was seen there
    empty: Any = SimpleNamespace(open_depth=room)
    points = np.zeros((5, 7, 3), np.float32)
    points[..., 2] = 1997.0
    image: Any = SimpleNamespace(points=points, part=np.s_[2:7, 2:9])
    found = find_foreground(image, empty)
    assert not found[1:4, 2:5].any(), "beside the shelf"
    found[1:4, 2:5] = True
    assert found.all()
    points[..., 2] = 1995.0
    assert find_foreground(image, empty).all()
    points[2, 3, 2] = NAN
    assert not find_foreground(image, empty)[2, 3]
    points[..., 2] = 4000.0
    nothing: Any = SimpleNamespace(open_depth=np.zeros((9, 11), np.float32))
    assert find_foreground(image, nothing).all(), (
        "where a room is seen nowhere, all stands before it"
    )


SKIN, DARK = 150, 12


def photographed(grey: np.ndarray, noise: float = 2.0) -> np.ndarray:
    """Through a lens whose blur has a sigma of a pixel, with noise."""
    blurred = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    blurred += np.random.default_rng(0).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


def skin_with_a_band(width: int, level: int = DARK) -> np.ndarray:
    """An image of skin with a dark upright band in its middle."""
    grey = np.full((60, 80), SKIN)
    grey[:, 40 - width // 2 : 40 + (width + 1) // 2] = level
    return grey


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("width", [2, 3, 5])
def test_a_narrow_gap_is_found(width: int, turned: bool) -> None:
    grey = skin_with_a_band(width)
    found = find_dark_gaps(photographed(grey.T if turned else grey))
    found = found.T if turned else found
    assert found[10:-10, 40].all()
    # The skin on both sides stays, but for the two pixels into which the dark is blurred.
    assert not found[:, : 40 - width // 2 - 2].any()
    assert not found[:, 40 + (width + 1) // 2 + 2 :].any()


SILHOUETTE = np.where(np.arange(80) < 30, DARK, SKIN) * np.ones((60, 1), int)


@pytest.mark.parametrize(
    ("grey", "noise"),
    [
        (skin_with_a_band(12), 2.0),
        (skin_with_a_band(30), 2.0),
        (SILHOUETTE, 2.0),
        (skin_with_a_band(3, SKIN // 2 + 10), 2.0),
        (np.full((200, 200), DARK), 5.0),
    ],
    ids=["wide", "wider", "silhouette", "faint", "dark"],
)
def test_what_is_dark_but_no_gap_stays(grey: np.ndarray, noise: float) -> None:
    assert not find_dark_gaps(photographed(grey, noise)).any()
