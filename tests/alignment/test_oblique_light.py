"""Light that comes out of the skin aside of where it entered: told by pairs that disagree, undone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from ray_cast_scan import Scan, cast_scan, load_body, load_rig

from bodyscan.alignment.icp import align
from bodyscan.alignment.oblique_light import (
    LEAST_MM,
    LightLine,
    ObliqueLight,
    _shared,
    _steady,
    find_oblique_light,
    take_out,
    to_unit_length,
    undo,
)
from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.triangulation import grid_normals
from bodyscan.settings import AlignmentSettings
from bodyscan.simulation.skin import came_in_at

NOISE_MM = 0.1
SETTINGS = AlignmentSettings(spacing_mm=6.0)


@dataclass(frozen=True, eq=False)
class Seen:
    """Range images of two poles' pairs without noise, and where their light comes from."""

    scan: Scan
    lines: dict[str, LightLine]
    prior: PoseCovariance

    def through_skin(self, aside_mm: float) -> list[RangeImage]:
        """As seen through such skin, noise and all: each pixel's ray meets the sheet of light
        that entered where what it sees came in."""
        rng = np.random.default_rng(4)
        return [self.seen_through(image, aside_mm, rng) for image in self.scan.range_images]

    def seen_through(
        self, image: RangeImage, aside_mm: float, rng: np.random.Generator
    ) -> RangeImage:
        line, valid = self.lines[image.pair], image.valid
        points = image.points[valid].astype(np.float64)
        normals = image.normals[valid].astype(np.float64)
        entered = came_in_at(points, line.origin - points, normals, aside_mm)
        sheet = np.cross(line.along, entered - line.origin)
        along = np.sum(sheet * line.origin, axis=1) / np.sum(sheet * points, axis=1)
        along += NOISE_MM * rng.standard_normal(len(along)) / np.linalg.norm(points, axis=1)
        seen = image.points.copy()
        seen[valid] = points * along[:, None]
        return replace(image, points=seen, normals=grid_normals(seen))

    def errors(self, images: list[RangeImage]) -> Array:
        """mm, along the rays."""
        apart = [
            np.linalg.norm(image.points[image.valid], axis=1)
            - np.linalg.norm(true.points[image.valid], axis=1)
            for image, true in zip(images, self.scan.range_images, strict=True)
        ]
        return np.concatenate(apart)


@pytest.fixture(scope="module")
def seen() -> Seen:
    rig = load_rig()
    rig = rig.model_copy(update={"pairs": [pair for pair in rig.pairs if pair.pole != "p3"]})
    scan = cast_scan(
        load_body(subdivisions=1), rig, scale=0.3, noise_mm=0.0, flying=0.0, floor=False
    )
    images = [
        replace(one, sigma_mm=np.where(one.valid, np.float32(NOISE_MM), one.sigma_mm))
        for one in scan.range_images
    ]
    lines = {}
    for pair in rig.pairs:
        assert pair.projector_nominal is not None
        light = np.array([pair.projector_nominal.position_mm])
        origin = scan.rig_from_camera[pair.name].inverse().apply(light)[0]
        lines[pair.name] = LightLine(origin, np.array([1.0, 0.0, 0.0]))
    # Boards leave 0.1 mm and 0.01 degrees open.
    own = np.diag([np.radians(0.01) ** 2] * 3 + [0.1**2] * 3)
    prior = PoseCovariance(tuple(lines), np.kron(np.eye(len(lines)), own).astype(float))
    return Seen(replace(scan, range_images=images), lines, prior)


def taken_out(
    seen: Seen, images: list[RangeImage], placed: dict[str, RigidTransform]
) -> tuple[list[RangeImage], ObliqueLight | None]:
    found = align(images, placed, seen.prior, SETTINGS)
    without, _, light = take_out(images, placed, found, seen.lines, seen.prior, SETTINGS)
    return without, light


def test_the_effect_of_skin_is_told_and_taken_out(seen: Seen) -> None:
    images = seen.through_skin(0.8)
    without, light = taken_out(seen, images, seen.scan.rig_from_camera)
    assert light is not None
    assert light.told
    # The length is known to a few hundredths; facets of 10 mm stand in for a smooth body.
    assert light.aside_mm == pytest.approx(0.8, abs=0.06)
    assert 0.003 < light.sigma_mm < 0.06
    before, after = (np.percentile(np.abs(seen.errors(some)), 90) for some in (images, without))
    assert before > 0.7
    # Normals are known to a degree or two, which is a tenth of the effect.
    assert after < 0.35 * before


def test_a_matt_body_stays_as_it_is(seen: Seen) -> None:
    images = seen.through_skin(0.0)
    without, light = taken_out(seen, images, seen.scan.rig_from_camera)
    assert light is not None
    assert not light.told
    assert light.sigma_mm < LEAST_MM
    assert all(one is other for one, other in zip(without, images, strict=True))


def test_sway_is_not_taken_for_it(seen: Seen) -> None:
    rng = np.random.default_rng(2)
    swayed = {
        name: RigidTransform(at.rotation, at.translation + rng.normal(0.0, 1.5, 3))
        for name, at in seen.scan.rig_from_camera.items()
    }
    _, light = taken_out(seen, seen.through_skin(0.0), swayed)
    assert light is not None
    assert not light.told
    _, light = taken_out(seen, seen.through_skin(0.8), swayed)
    assert light is not None
    assert light.aside_mm == pytest.approx(0.8, abs=0.1)


def test_few_pairs_do_not_tell(seen: Seen) -> None:
    images = seen.through_skin(0.8)[:3]
    placed = seen.scan.rig_from_camera
    assert find_oblique_light(images, placed, seen.lines, seen.prior, SETTINGS) is None


def test_sheets_that_are_parallel_meet_nowhere() -> None:
    planes = np.column_stack([np.tile([0.0, 0.8, 0.6], (40, 1)), 900.0 + 10.0 * np.arange(40)])
    assert LightLine.of(LightPlanes(planes, np.zeros((40, 4, 4)), "horizontal")) is None


def test_what_is_not_known_is_in_sigmas(seen: Seen) -> None:
    image = seen.through_skin(0.0)[1]
    line, valid = seen.lines[image.pair], image.valid
    unknown = undo(image, line, ObliqueLight(0.0, 0.5))
    np.testing.assert_array_equal(unknown.points, image.points)
    assert unknown.common_mm is not None
    assert np.all(unknown.sigma_mm[valid] >= image.sigma_mm[valid])
    # Through skin of half a millimetre these points would be off by as much as that says.
    lifted = seen.seen_through(seen.scan.range_images[1], 0.5, np.random.default_rng(0))
    wrong = np.linalg.norm(lifted.points[valid] - seen.scan.range_images[1].points[valid], axis=1)
    ratio = np.median(wrong) / np.median(unknown.common_mm[valid])
    assert ratio == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("along", [[1.0, 0.02, -0.05], [0.03, 1.0, 0.1]])
def test_light_comes_from_where_its_sheets_meet(along: list[float]) -> None:
    way = np.array(along) / np.linalg.norm(along)
    origin = np.array([5.0, -280.0, 20.0]) - way * (way @ np.array([5.0, -280.0, 20.0]))
    aim = np.array([0.0, 0.0, 1300.0]) + np.linspace(-400, 400, 40)[:, None] * np.cross(
        way, [0.0, 0.0, 1.0]
    )
    normals = np.cross(way, aim - origin)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.column_stack([normals, -normals @ origin])
    planes[7] = np.nan  # a stripe that no board showed
    planes *= np.where(planes[:, 3:] < 0.0, -1.0, 1.0)
    line = LightLine.of(LightPlanes(planes, np.zeros((40, 4, 4)), "horizontal"))
    assert line is not None
    np.testing.assert_allclose(line.origin, origin, atol=1e-6)
    assert abs(line.along @ way) == pytest.approx(1.0)


def test_means_of_normals_are_brought_to_unit_length() -> None:
    normals = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    normals[::7] *= np.float32(1e-5)  # next to nothing is left where they look all ways
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    expected = np.where(length > 1e-3, normals / length, np.float32(np.nan))
    to_unit_length(normals)
    np.testing.assert_allclose(normals, expected, rtol=1e-6)


def test_a_match_twice_its_spread_away_says_half_as_much() -> None:
    """And one where light grazes says nothing."""
    rng = np.random.default_rng(3)
    points, normals = rng.standard_normal((41, 3)), np.tile([0.0, 0.0, 1.0], (41, 1))
    distances = np.where(np.arange(41) % 2, 0.3, -0.3)
    sigma, lifted = np.full(41, 0.2), np.ones(41)
    lifted[3] = np.nan
    spread2 = 0.2**2 + (1.4826 * 0.3) ** 2
    distances[7] = 2.0 * np.sqrt(spread2)
    found = _shared(points, normals, distances, sigma, lifted, 5.0)
    weight = 1.0 / (spread2 + 0.25 * 0.3**2) / 5.0
    far = 0.5 / spread2 / 5.0
    assert found.information[6, 6] == pytest.approx(39 * weight + far, rel=1e-3)
    assert found.information[5, 6] == pytest.approx(39 * weight + far, rel=1e-3)
    even = weight * (-0.3 * 21 + 0.3 * 18) + far * distances[7]
    assert found.gradient[6] == pytest.approx(even, rel=1e-3)


@pytest.mark.parametrize(("pixel_mm", "reach"), [(0.5, 7), (1.0, 4), (20.0, 1)])
def test_normals_are_averaged_over_seven_millimetres_or_three_pixels(
    pixel_mm: float, reach: int
) -> None:
    """Half of 7 mm to either side of an edge, which lies between two columns; pixels are whole."""
    plain = Camera(1000.0, 1000.0, 0.0, 19.5, 9.5, Radial(), 40, 20)
    points = (1000.0 * pixel_mm * plain.pixel_rays()).astype(np.float32)
    normals = np.empty_like(points)
    normals[:, :20], normals[:, 20:] = [0.6, 0.0, -0.8], [-0.6, 0.0, -0.8]
    none = np.zeros(points.shape[:2])
    image = RangeImage("p", plain, points, normals, none.astype(np.float32), none.astype(np.uint8))
    mixed = np.abs(_steady(image)[10, :, 0]) < 0.599
    assert np.flatnonzero(mixed).tolist() == list(range(20 - reach, 20 + reach))
