"""Skin, hair and dark cloth of a cloud, and which of its points are on the head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from made_bodies import cloud_of
from ray_cast_scan import Scan, cast_scan, load_body, load_rig

from bodyscan.arrays import Bytes, Mask
from bodyscan.fusion.regions import Regions, find_head, label_regions
from bodyscan.mesh.body import DARK_CLOTH, HAIR, SKIN, UNSURE
from bodyscan.motion.body_parts import NECK
from bodyscan.reconstruction.range_image import RangeImage

BRIGHT = 120
NOISE_MM = 0.05


@dataclass(frozen=True, eq=False)
class Seen:
    """Range images of a body all of one grey."""

    images: Sequence[RangeImage]
    scan: Scan

    def in_rig(self, image: RangeImage) -> np.ndarray:
        return self.scan.rig_from_camera[image.pair].apply(image.points.astype(float))

    def labels(self, images: Sequence[RangeImage]) -> list[Bytes]:
        """Of each image's pixels."""
        ends = np.cumsum([image.valid.sum() for image in images])[:-1]
        return np.split(self.regions(images).numbers, ends)

    def regions(self, images: Sequence[RangeImage]) -> Regions:
        """The cloud is all pixels."""
        valid = [image.valid for image in images]
        points = np.concatenate(
            [self.in_rig(image)[v] for image, v in zip(images, valid, strict=True)]
        )
        grey = np.concatenate([image.colours[v] for image, v in zip(images, valid, strict=True)])
        cloud = cloud_of(points, np.zeros(3), NOISE_MM)
        cloud = replace(cloud, colours=np.repeat(grey[:, None], 3, axis=1))
        return label_regions(cloud, images, self.scan.rig_from_camera, 7.0)


@pytest.fixture(scope="module")
def seen() -> Seen:
    """By one pole, pixels 3 mm apart."""
    rig = load_rig()
    rig = rig.model_copy(update={"pairs": [pair for pair in rig.pairs if pair.pole == "p1"]})
    scan = cast_scan(
        load_body(subdivisions=1), rig, scale=0.3, noise_mm=NOISE_MM, flying=0.0, floor=False
    )
    images = [replace(one, colours=np.full_like(one.colours, BRIGHT)) for one in scan.range_images]
    return Seen(images, scan)


def scalp(seen: Seen, image: RangeImage) -> Mask:
    """Above a line that rises to the forehead; the subject faces x."""
    points = seen.in_rig(image)
    top = seen.scan.truth.vertices[:, 2].max()
    return np.asarray(points[..., 2] > 0.945 * top + 0.5 * points[..., 0])


def between(seen: Seen, image: RangeImage, low: float, high: float) -> Mask:
    """In statures, not as far out as hands are."""
    points, top = seen.in_rig(image), seen.scan.truth.vertices[:, 2].max()
    height = points[..., 2] / top
    return np.asarray((height > low) & (height < high) & (np.abs(points[..., 1]) < 0.15 * top))


def covered(image: RangeImage, where: Mask, grey: int, rough_mm: float = 0.0) -> RangeImage:
    """Darker there, and rough by so much, which no sigma knows of."""
    rng = np.random.default_rng(7)
    away = 1.0 + where * rough_mm * rng.standard_normal(where.shape) / image.points[..., 2]
    return replace(
        image,
        colours=np.where(where, grey, image.colours).astype(np.uint8),
        points=(image.points * away[..., None]).astype(np.float32),
    )


def share(
    found: Sequence[Bytes], where: Sequence[Mask], images: Sequence[RangeImage], kind: int
) -> float:
    """Of what lies `where`, so much is of that kind."""
    own = np.concatenate([one[w[i.valid]] for one, w, i in zip(found, where, images, strict=True)])
    return float(np.mean(own == kind))


def test_a_matt_body_is_skin_all_over(seen: Seen) -> None:
    found = np.concatenate(seen.labels(seen.images))
    # Ears and eyelids are as rough as hair, and one sees no more of them than that.
    assert np.mean(found == SKIN) > 0.99
    assert not np.isin(found, (HAIR, DARK_CLOTH)).any()


def test_hair_and_shorts_are_told_apart(seen: Seen) -> None:
    hair = [scalp(seen, image) for image in seen.images]
    shorts = [between(seen, image, 0.41, 0.565) for image in seen.images]
    images = [
        covered(covered(image, h, 6, rough_mm=1.0), s, 9)
        for image, h, s in zip(seen.images, hair, shorts, strict=True)
    ]
    found = seen.labels(images)
    # Cells are 30 mm: what is at the rim of a patch may be a cell that tells too little.
    assert share(found, hair, images, HAIR) > 0.97
    assert share(found, shorts, images, DARK_CLOTH) > 0.97
    bare = [~(h | s) for h, s in zip(hair, shorts, strict=True)]
    # Bright points of a cell that is mostly dark are highlights, or beside the rim.
    assert share(found, bare, images, SKIN) > 0.97


@pytest.mark.parametrize(("grey", "kind"), [(0.55, SKIN), (0.45, UNSURE)])
def test_skin_in_shade_is_skin_down_to_half_the_usual_light(
    seen: Seen, grey: float, kind: int
) -> None:
    shade = [between(seen, image, 0.41, 0.565) for image in seen.images]
    images = [
        covered(image, s, round(grey * BRIGHT)) for image, s in zip(seen.images, shade, strict=True)
    ]
    assert share(seen.labels(images), shade, images, kind) == 1.0


@pytest.mark.parametrize("rough_mm", [0.5, 1.0, 2.0])
def test_hair_stands_off_by_how_rough_it_is_beyond_its_noise(seen: Seen, rough_mm: float) -> None:
    """In the median of its points to a fifth: a window of five pixels fits a twentieth of the
    scatter away, and cells hold a hundred pixels. Skin does not stand off."""
    noise_mm = np.float32(0.8)
    hair = [scalp(seen, image) for image in seen.images]
    images = [
        replace(
            covered(image, h, 6, rough_mm=float(np.hypot(rough_mm, noise_mm))),
            sigma_mm=np.where(h, noise_mm, image.sigma_mm) + 0 * image.sigma_mm,
        )
        for image, h in zip(seen.images, hair, strict=True)
    ]
    found = seen.regions(images)
    of_hair = np.concatenate([h[i.valid] for h, i in zip(hair, images, strict=True)])
    own = of_hair & (found.numbers == HAIR)
    assert np.median(found.relief_mm[own]) == pytest.approx(rough_mm, rel=0.2)
    assert not found.relief_mm[found.numbers != HAIR].any()


def test_hair_is_told_by_its_place_where_noise_hides_that_it_is_rough(seen: Seen) -> None:
    hair = [scalp(seen, image) for image in seen.images]
    images = [
        replace(
            covered(image, h, 6, rough_mm=0.8),
            sigma_mm=np.where(h, np.float32(0.8), image.sigma_mm) + 0 * image.sigma_mm,
        )
        for image, h in zip(seen.images, hair, strict=True)
    ]
    assert share(seen.labels(images), hair, images, HAIR) > 0.97


def test_a_smooth_cap_is_no_hair(seen: Seen) -> None:
    cap = [scalp(seen, image) for image in seen.images]
    images = [covered(image, c, 6) for image, c in zip(seen.images, cap, strict=True)]
    found = seen.labels(images)
    assert share(found, cap, images, DARK_CLOTH) > 0.97


def test_long_hair_ends_where_a_dark_shirt_begins(seen: Seen) -> None:
    """Both are one patch: below the neck it is by how rough they are."""
    hair = [
        scalp(seen, image) | (between(seen, image, 0.75, 0.9) & (seen.in_rig(image)[..., 1] > 0))
        for image in seen.images
    ]
    shirt = [between(seen, image, 0.62, 0.75) for image in seen.images]
    images = [
        covered(covered(image, h, 6, rough_mm=1.0), s, 9)
        for image, h, s in zip(seen.images, hair, shirt, strict=True)
    ]
    found = seen.labels(images)
    hanging = [h & between(seen, i, 0.77, 0.85) for h, i in zip(hair, images, strict=True)]
    assert share(found, hanging, images, HAIR) > 0.9
    assert share(found, shirt, images, DARK_CLOTH) > 0.9


def test_bright_hair_is_not_taken_for_skin(seen: Seen) -> None:
    hair = [scalp(seen, image) for image in seen.images]
    images = [
        covered(image, h, BRIGHT, rough_mm=1.0) for image, h in zip(seen.images, hair, strict=True)
    ]
    found = seen.labels(images)
    # At the rim of what a camera sees no window of 7 mm is whole.
    assert share(found, hair, images, UNSURE) > 0.85
    assert share(found, [~h for h in hair], images, SKIN) > 0.98


@pytest.mark.parametrize("skin", [0.5, 1.0, 2.0])
def test_it_does_not_matter_how_pale_the_skin_or_how_long_the_exposure_is(
    seen: Seen, skin: float
) -> None:
    hair = [scalp(seen, image) for image in seen.images]
    images = [
        covered(
            replace(image, colours=(skin * image.colours).astype(np.uint8)),
            h,
            round(0.2 * skin * BRIGHT),
            rough_mm=1.0,
        )
        for image, h in zip(seen.images, hair, strict=True)
    ]
    assert share(seen.labels(images), hair, images, HAIR) > 0.97


@pytest.mark.parametrize("why", ["images too dark", "black clothes nearly all over"])
def test_where_it_cannot_be_known_what_is_skin_all_is_unsure(seen: Seen, why: str) -> None:
    def shown(image: RangeImage) -> RangeImage:
        if why == "images too dark":
            return replace(image, colours=np.full_like(image.colours, 15))
        return covered(image, between(seen, image, 0.1, 0.8), 10)

    found = np.concatenate(seen.labels([shown(image) for image in seen.images]))
    assert np.all(found == UNSURE)


def test_a_head_is_above_the_neck_and_near_the_middle_of_the_upper_body() -> None:
    z = np.linspace(0.0, 1700.0, 1701)
    points = np.column_stack([np.where(z < 840.0, 600.0, 50.0), np.full(1701, -30.0), z])
    # Most of what is seen are legs far ahead, which say nothing of where the upper body is.
    points = np.vstack([points, points[:840], points[:840]])
    wide, neck = 0.12 * 1700.0, NECK * 1700.0
    places = np.array(
        [
            [50.0, -30.0, neck + 1.0], [50.0, -30.0, neck - 1.0], [50.0 + wide - 1.0, -30.0, 1600.0],
            [50.0 + wide + 1.0, -30.0, 1600.0], [50.0, -31.0 - wide, 1600.0], [50.0, -30.0, 1700.0],
        ]
    )  # fmt: skip
    assert find_head(points, places).tolist() == [True, False, True, False, False, True]
