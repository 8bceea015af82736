"""Every model of the light against its own derivatives, and against the chapter's planes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sheet_models import MATRIX, MIDDLE, PINHOLE, STRIPES, by_offset, models, moved

from bodyscan.arrays import Array
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import LightPlanes, LightSheets, SmoothSheets
from bodyscan.geometry.light_sheets import intersect_rays, sheets_from_arrays, sheets_to_arrays


def some_points(rng: np.random.Generator, count: int = 50) -> tuple[np.ndarray, np.ndarray]:
    points = MIDDLE + rng.uniform(-250.0, 250.0, (count, 3))
    return points, rng.uniform(10.0, 190.0, count)


def sliced(model: SmoothSheets, rays: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """s at which rays are measured at a depth, by bisection: depth falls or grows with s."""
    low, high = np.zeros(len(rays)), np.full(len(rays), float(STRIPES))
    first, last = (
        model.offset(rays * depth[:, None], model.evaluate(s)).value for s in (low, high)
    )
    grows = first > last
    for _ in range(60):
        middle = 0.5 * (low + high)
        off = model.offset(rays * depth[:, None], model.evaluate(middle)).value
        above = (off > 0) == grows
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return 0.5 * (low + high)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_derivatives_are_those_of_the_offset(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, s = some_points(rng)
    for model in models(seed):
        assert_derivatives(model, points, s)


def assert_derivatives(model: SmoothSheets, points: Array, s: Array) -> None:
    def moved_points(by: Array) -> Array:
        return model.offset(points + by, model.evaluate(s)).value

    def moved_parameters(by: Array) -> Array:
        other = model.retract(by)
        return other.offset(points, other.evaluate(s)).value

    def slope(change: Callable[[Array], Array], axis: Array, step: float) -> Array:
        return (change(step * axis) - change(-step * axis)) / (2.0 * step)

    offset = model.offset(points, model.evaluate(s), parameters=True)
    for k, axis in enumerate(np.eye(3)):
        # Central differences over 0.01 mm in 1300: rounding and curvature below 1e-6.
        by_point = slope(moved_points, axis, 0.01)
        assert np.allclose(offset.by_point[:, k], by_point, rtol=1e-5, atol=1e-8)
    assert offset.by_parameter is not None
    for k, axis in enumerate(np.eye(len(model.covariance))):
        size = np.abs(offset.by_parameter[:, k]).max() + 1e-12
        by_parameter = slope(moved_parameters, axis, 1e-6 / size)
        assert np.allclose(offset.by_parameter[:, k], by_parameter, rtol=1e-4, atol=1e-4 * size)


@pytest.mark.slow
@settings(max_examples=2, deadline=None)
@given(st.integers(0, 10_000))
def test_variance_is_that_of_sheets_drawn_from_the_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, _ = some_points(rng, 8)
    rays, depth = points / points[:, 2:], points[:, 2]
    for model in models(seed):
        s = sliced(model, rays, depth)
        factor = np.linalg.cholesky(model.covariance + 1e-30 * np.eye(len(model.covariance)))
        draws = [
            model.retract(factor @ rng.standard_normal(len(factor))).intersect(rays, s).depth
            for _ in range(200)
        ]
        # 200 draws give a standard deviation to 5 percent; five times that.
        ratio = np.std(draws, axis=0) / np.sqrt(model.intersect(rays, s).variance_mm2)
        inside = (s > 5.0) & (s < STRIPES - 5.0)
        assert np.all(np.abs(ratio[inside] - 1.0) < 0.25)


def test_smooth_planes_of_earlier_versions_are_planes() -> None:
    arrays = sheets_to_arrays(models(4)[4])
    old = {"parameters": arrays["parameters"][:24], "covariance": arrays["covariance"][:24, :24]}
    model = sheets_from_arrays("smooth-planes", arrays | old, "horizontal")
    index = np.arange(STRIPES + 1.0)
    planes = model.tangent_planes(index)
    chapter = LightPlanes(planes, np.zeros((STRIPES + 1, 4, 4)), "horizontal")
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.3, 0.3, (300, 2)), np.ones(300)])
    s = rng.integers(1, STRIPES, 300).astype(float)
    # Far away rays and planes are nearly parallel: compare where a scanner measures.
    depth = chapter.intersect(rays, s).depth
    near = np.isfinite(depth) & (depth > 500.0) & (depth < 3000.0)
    assert near.sum() > 50
    assert np.allclose(model.intersect(rays, s).depth[near], depth[near], rtol=1e-8)


def test_a_lens_without_distortion_is_the_two_by_four_matrix() -> None:
    points, _ = some_points(np.random.default_rng(2))
    homogeneous = np.column_stack([points, np.ones(len(points))])
    above, below = MATRIX @ homogeneous.T
    assert np.allclose(PINHOLE.stripe(points), above / below, rtol=1e-12)
    assert abs(PINHOLE.projector_from_camera.apply(MIDDLE)[0]) < 1e-9


def test_turning_a_projector_moves_its_axis_and_little_else() -> None:
    turned = PINHOLE.rotate_to(140.0)
    assert turned.parameters[1] == 140.0
    assert np.allclose(turned.projector_from_camera.inverse().translation,
                       PINHOLE.projector_from_camera.inverse().translation)  # fmt: skip
    # What the axis meets is lit by the stripe it was lit by before, to second order in the turn.
    along = turned.projector_from_camera.inverse().apply(np.array([0.0, 0.0, 1300.0]))
    assert abs(PINHOLE.stripe(along) - 140.0) < 1e-6


def test_arrays_hold_everything() -> None:
    rng = np.random.default_rng(5)
    points, s = some_points(rng)
    rays = points / points[:, 2:]
    planes = LightPlanes(rng.normal(size=(5, 4)), rng.normal(size=(5, 4, 4)), "vertical")
    every: list[LightSheets] = [*models(7), planes]
    for sheets in every:
        again = sheets_from_arrays(sheets.kind, sheets_to_arrays(sheets), sheets.direction)
        assert type(again) is type(sheets)
        assert (again.kind, again.direction) == (sheets.kind, sheets.direction)
        assert again.stripes == sheets.stripes
        for left, right in zip(
            sheets_to_arrays(sheets).values(), sheets_to_arrays(again).values(), strict=True
        ):
            assert np.array_equal(left, right)
        assert np.array_equal(
            again.intersect(rays, s).depth, sheets.intersect(rays, s).depth, equal_nan=True
        )


def test_arrays_of_another_kind_are_refused() -> None:
    bowed = models(0)[5]
    with pytest.raises(ValueError, match="smooth-planes"):
        sheets_from_arrays("smooth-planes", sheets_to_arrays(bowed), "horizontal")
    with pytest.raises(ValueError, match="cones"):
        sheets_from_arrays("cones", sheets_to_arrays(bowed), "horizontal")


def test_planes_have_slope_and_variance_between_two_and_at_the_last() -> None:
    planes = models(4)[4].tangent_planes(np.arange(STRIPES + 1.0))
    spread = np.zeros((STRIPES + 1, 4, 4))
    spread[:, 3, 3] = 0.01
    planes[150] = np.nan
    chapter = LightPlanes(planes, spread, "horizontal")
    ray = np.array([[0.02, 0.01, 1.0]])
    for place in (100.5, 149.0, 151.0, 99.0):
        s = np.array([place])
        depth = chapter.intersect(ray, s).depth
        side = -1.0 if place == 149.0 else 1.0
        nearby = chapter.intersect(ray, s + side * 1e-6).depth
        slope = (nearby - depth) / (side * 1e-6)
        assert np.allclose(chapter.intersect(ray, s).per_stripe, slope, rtol=1e-4)
        facing = chapter.tangent_planes(s)[0, :3] @ ray[0]
        # A plane's offset, 0.1 mm uncertain, moves the depth by that over n . ray.
        assert np.allclose(chapter.intersect(ray, s).variance_mm2, 0.01 / facing**2)
    assert np.isnan(chapter.intersect(ray, np.array([149.5])).variance_mm2).all()


def test_planes_of_any_length_and_sign_measure_and_do_not_say_how_well() -> None:
    planes = models(4)[4].tangent_planes(np.arange(STRIPES + 1.0))
    factor = np.random.default_rng(3).uniform(0.5, 3.0, (STRIPES + 1, 1))
    factor[::2] *= -1.0
    exact = LightPlanes.from_planes(factor * planes, "horizontal")
    np.testing.assert_allclose(exact.coefficients, planes, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(exact.coefficients[:, :3], axis=1), 1.0)
    assert (exact.coefficients[:, 3] > 0.0).all()
    assert exact.stripes == STRIPES
    ray, s = np.array([[0.02, 0.01, 1.0]]), np.array([100.5])
    assert np.isfinite(exact.intersect(ray, s).depth).all()
    assert np.isnan(exact.intersect(ray, s).variance_mm2).all()
    again = sheets_from_arrays("planes", sheets_to_arrays(exact), "horizontal")
    assert np.isnan(again.intersect(ray, s).variance_mm2).all()


def test_a_plane_behind_the_camera_measures_nothing() -> None:
    ahead, behind = [0.0, 0.0, -1.0, 500.0], [0.0, 0.0, 1.0, 500.0]
    planes = LightPlanes.from_planes(np.array([ahead, ahead, behind, behind]), "vertical")
    depth = planes.intersect(np.tile([0.1, 0.0, 1.0], (2, 1)), np.array([0.5, 2.5])).depth
    np.testing.assert_allclose(depth, [500.0, np.nan])


def test_what_is_too_uncertain_is_not_measured() -> None:
    """More uncertain than a thousandth of the distance, and than thrice what is amid the boards."""
    model = models(2)[0]
    assert isinstance(model, LensSheets)
    rng = np.random.default_rng(6)
    points = MIDDLE + rng.uniform(-400.0, 400.0, (3000, 3))
    points *= rng.uniform(0.5, 8.0, (3000, 1))  # far beyond the boards too
    rays = points / points[:, 2:]
    s = model.stripe(points)
    inside = (s > 0) & (s < STRIPES)
    depth = model.intersect(rays[inside], s[inside]).depth
    share = np.sqrt(model.intersect(rays[inside], s[inside]).variance_mm2) / depth
    amid_boards = model.stripe(MIDDLE[None])
    amid = (
        float(np.sqrt(model.intersect(MIDDLE[None] / MIDDLE[2], amid_boards).variance_mm2[0]))
        / MIDDLE[2]
    )
    for at_the_boards, most in ((1e-4, 1e-3), (1e-3, 3e-3), (1e-2, 3e-2)):
        scaled = share * at_the_boards / amid
        worse = replace(model, covariance=model.covariance * (at_the_boards / amid) ** 2)
        kept = np.isfinite(intersect_rays(worse, rays[inside], s[inside]).depth)
        clear = np.abs(scaled / most - 1.0) > 0.02  # the stripe amid the boards is a whole one
        np.testing.assert_array_equal(kept[clear], scaled[clear] < most)
        assert kept.sum() > 0
    assert kept.sum() < inside.sum()


@pytest.mark.parametrize("terms", [0, 1, 4, 5, 8])
def test_a_lens_measures_rays_as_newtons_method_on_its_offset_does(terms: int) -> None:
    model = moved(PINHOLE.with_lens(terms), np.random.default_rng(terms))
    rng = np.random.default_rng(13)
    points = MIDDLE + rng.uniform(-400.0, 400.0, (3000, 3))
    rays, s = points / points[:, 2:], rng.uniform(-20.0, STRIPES + 20.0, 3000)
    s[::50] = np.nan
    found = model.intersect(rays, s)
    known = np.isfinite(found.depth)
    assert 0.2 < known.mean() < 0.95
    expected = by_offset(model, rays[known], s[known], found.depth[known])
    # Newton's steps end at 1e-7 of the depth, where the next one is the square of that.
    for value, wanted, rtol in zip(found, expected, (1e-11, 1e-8, 1e-8), strict=True):
        np.testing.assert_array_equal(np.isfinite(value), known)
        np.testing.assert_allclose(value[known], wanted, rtol=rtol)


@pytest.mark.parametrize("terms", [0, 4])
def test_the_first_and_the_last_boundary_are_measured_as_well(terms: int) -> None:
    model = PINHOLE.with_lens(terms)
    s = np.array([0.0, float(STRIPES)])
    first, last = (MIDDLE + [0.0, y, 0.0] for y in (-284.0, 598.0))
    rays = np.stack([first, last]) / [[first[2]], [last[2]]]
    depth = model.intersect(rays, s).depth
    np.testing.assert_allclose(model.stripe(rays * depth[:, None]), s, atol=1e-6)
    beyond = np.array([-1e-9, STRIPES + 1e-9])
    assert np.isnan(model.intersect(rays, beyond).depth).all()


def test_a_ray_that_falls_steeply_never_meets_the_light_that_falls_least() -> None:
    """Below the projector."""
    assert np.isnan(PINHOLE.intersect(np.array([[0.0, 3.0, 1.0]]), np.array([10.0])).depth).all()


@pytest.mark.parametrize(
    "model",
    [
        *(PINHOLE.with_lens(terms) for terms in (0, 1, 4, 8)),
        *(BowedSheets.from_pinhole(PINHOLE, terms) for terms in (1, 3)),
    ],
    ids=lambda model: f"{model.kind}-{len(model.parameters)}",
)
def test_what_is_known_beforehand_has_its_own_derivatives(model: SmoothSheets) -> None:
    """Where nothing speaks against it: residuals are in standard deviations, of which there are more
    the more a model can bend."""
    known, jacobian = model.linearize_prior()
    assert jacobian.shape == (len(known), len(model.covariance))
    for k, axis in enumerate(np.eye(len(model.covariance))):
        ahead, behind = (model.retract(step * axis).linearize_prior()[0] for step in (1e-6, -1e-6))
        # Linear in the step but for rounding, of up to 1e5 standard deviations.
        np.testing.assert_allclose((ahead - behind) / 2e-6, jacobian[:, k], rtol=1e-6, atol=1e-6)
