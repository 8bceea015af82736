"""Rendered images against light worked out by hand, and their interpolation against every ray cast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d
import pytest
from small_view import CAMERA, CRISP, LAMPS, SHARP, STRIPES, projector, view, wall

from bodyscan.arrays import Floats
from bodyscan.rig.board import Board
from bodyscan.simulation.board import make_print
from bodyscan.simulation.layout import build_mirror, build_pinhole
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.patterns import compute_gray_code_bits
from bodyscan.simulation.projector import MirrorProjector, PinholeProjector
from bodyscan.simulation.rays import View, interpolate, trace_band
from bodyscan.simulation.render import compute_pixel_truth, render_pair
from bodyscan.simulation.scene import Scene, Surface, build_grid_surface
from bodyscan.simulation.sensor import blur, expose, list_blurs
from bodyscan.simulation.settings import BoardMaking, Noise, Optics, Projection

BITS = 5


def ball(centre: list[float], radius: float, resolution: int = 60) -> Surface:
    mesh = o3d.geometry.TriangleMesh.create_sphere(radius, resolution)
    mesh.compute_vertex_normals()
    vertices = np.asarray(mesh.vertices) + centre
    return Surface(
        vertices, np.asarray(mesh.triangles), 0.8, normals=np.asarray(mesh.vertex_normals)
    )


def render(
    surfaces: list[Surface],
    *,
    projection: Projection = CRISP,
    optics: Optics = SHARP,
    light: MirrorProjector | PinholeProjector | None = None,
) -> dict[str, Floats]:
    return render_pair(
        Scene(surfaces),
        view(optics),
        light or projector(projection=projection),
        LAMPS,
        projection,
        np.random.default_rng(0),
    )


def read(images: dict[str, np.ndarray]) -> np.ndarray:
    """Stripe number of each pixel, by looking the bits up (no arithmetic on Gray code)."""
    bits = [images[f"bit{k:02d}"] > images[f"bit{k:02d}-inverse"] for k in range(BITS)]
    table = np.full(2**BITS, -1)
    places = 2 ** np.arange(BITS)
    table[places @ compute_gray_code_bits(STRIPES)] = np.arange(STRIPES)
    return table[np.tensordot(places, np.stack(bits), axes=1)]


@pytest.mark.parametrize("build", [build_mirror, build_pinhole])
def test_frames_read_as_the_true_stripe(build: Callable[..., MirrorProjector]) -> None:
    surfaces = [wall(1500.0, albedo=0.7), ball([40.0, -30.0, 1000.0], 200.0)]
    light = projector(build)
    images = render(surfaces, light=light)
    truth = compute_pixel_truth(Scene(surfaces), CAMERA, light)
    inside = np.mod(truth.s, 1.0)
    slope = np.abs(np.gradient(truth.s)).max(axis=0)
    # a pixel wholly inside a stripe: its middle lies more than half a pixel's s from a boundary
    whole = (inside > slope) & (inside < 1 - slope) & (slope < 0.5)
    assert whole.mean() > 0.25
    assert (read(images)[whole] == np.floor(truth.s[whole])).all()


def test_depth_is_that_of_the_surfaces() -> None:
    truth = compute_pixel_truth(
        Scene([wall(1500.0), ball([0.0, 0.0, 1000.0], 200.0)]), CAMERA, projector()
    )
    rays = CAMERA.directions(CAMERA.grid())
    b, c = rays @ np.array([0, 0, 1000.0]), 1000.0**2 - 200.0**2
    root = b**2 - np.sum(rays**2, axis=-1) * c
    sphere = (b - np.sqrt(np.maximum(root, 0))) / np.sum(rays**2, axis=-1)
    deep, off = root > 4e3, root < -4e3  # well inside, well outside of the outline (4e4 its middle)
    assert deep.any()
    # facets of 3 degrees both ways lie up to 2 x 200 (1 - cos 1.5 deg) = 0.14 mm inside the sphere,
    # along a ray that slants by 71 degrees (root = 4e3) three times that
    assert truth.depth[deep] == pytest.approx(sphere[deep], abs=0.45)
    assert (truth.depth[deep] >= sphere[deep] - 1e-3).all()
    assert truth.depth[off] == pytest.approx(1500.0, abs=1e-3)


def test_brightness_is_albedo_cosine_and_inverse_square() -> None:
    light = projector()
    images = render([wall(1200.0, albedo=0.5)], light=light)
    truth = compute_pixel_truth(Scene([wall(1200.0)]), CAMERA, light)
    points = CAMERA.directions(CAMERA.grid()) * 1200.0
    towards = light.source(truth.s) - points
    distance = np.linalg.norm(towards, axis=-1)
    expected = 200.0 * 0.5 * (-towards[..., 2] / distance) * (1000.0 / distance) ** 2 + 10.0 * 0.5
    inside = np.isfinite(truth.s) & (truth.s > 1) & (truth.s < STRIPES - 1)
    assert inside.mean() > 0.8
    # nine samples spread over a pixel against its middle: brightness changes 0.3 % a pixel
    assert images["lit"][inside] == pytest.approx(expected[inside], rel=2e-3)
    assert images["dark"] == pytest.approx(np.full((128, 160), 5.0), abs=1e-4)


def test_pattern_and_inverse_add_up_to_lit() -> None:
    images = render([wall(1200.0)], projection=Projection(blur_stripes=0.25))
    for k in range(BITS):
        total = images[f"bit{k:02d}"] + images[f"bit{k:02d}-inverse"] - images["dark"]
        assert total == pytest.approx(images["lit"], abs=1e-3)


def test_shadow_falls_away_from_the_mirrored_apex() -> None:
    """A pixel of the wall is dark exactly if the ball stands between it and the light."""
    middle, radius = np.array([0.0, -60.0, 950.0]), 90.0
    light = projector()
    surfaces = [wall(1500.0), ball(list(middle), radius)]
    images = render(surfaces, light=light)
    truth = compute_pixel_truth(Scene(surfaces), CAMERA, light)
    points = CAMERA.directions(CAMERA.grid()) * 1500.0
    source = light.source(light.stripe(points))
    way = source - points
    arm = middle - points
    along = np.sum(arm * way, axis=-1) / np.sum(way * way, axis=-1)
    miss = np.linalg.norm(arm - along[..., None] * way, axis=-1)
    at_wall = (np.abs(truth.depth - 1500.0) < 1.0).astype(np.uint8)
    on_wall = cv2.erode(at_wall, np.ones((3, 3), np.uint8)) > 0  # no pixel shows the ball in part
    swept = (light.stripe(points) > 0.5) & (light.stripe(points) < STRIPES - 0.5)
    dark = images["lit"] - images["dark"] < 1e-3
    margin = 15.0  # mm: more than a pixel, which is 8 mm at the wall
    assert (on_wall & (miss < radius - margin)).sum() > 100
    assert dark[on_wall & swept & (miss < radius - margin)].all()
    assert not dark[on_wall & swept & (miss > radius + margin)].any()


def test_a_surface_turned_away_from_the_light_stays_dark() -> None:
    """Seen from below, lit from above: a ledge whose upper side the light meets."""
    ledge = build_grid_surface(
        np.array([-200.0, -100.0, 900.0]), np.array([400.0, 0, 0]), np.array([0, 25.0, 300.0])
    )
    light = projector()
    truth = compute_pixel_truth(Scene([ledge, wall(3000.0)]), CAMERA, light)
    seen = truth.depth < 1300
    assert seen.sum() > 200
    assert np.isnan(truth.s[seen]).all()


def test_an_edge_lies_where_it_is() -> None:
    """Coverage of an upright edge, summed over rows, finds it to a hundredth of a pixel."""
    place = 17.3
    half = build_grid_surface(
        np.array([place, -2000.0, 1000.0]), np.array([2000.0, 0, 0]), np.array([0, 4000.0, 0])
    )
    straight = TrueCamera(190.0, 190.0, 0.0, 80.0, 64.0, 0.0, 0.0, 160, 128)
    sharp = View.from_camera(straight, SHARP, np.random.default_rng(0))
    images = render_pair(Scene([half]), sharp, projector(), LAMPS, CRISP, np.random.default_rng(0))
    covered = images["dark"] / images["dark"].max()
    edge = 160 - covered.sum(axis=1).mean() - 0.5
    assert edge == pytest.approx(80.0 + 190.0 * place / 1000.0, abs=0.01)


def test_noise_is_shot_and_read_noise() -> None:
    flat = np.full((400, 400), 200.3, np.float32)
    grey = expose(flat, Noise(), np.random.default_rng(0)).astype(float)
    expected = np.sqrt(200.3 / 140 + 0.7**2 + 1 / 12)  # rounding adds a twelfth
    assert grey.mean() == pytest.approx(200.3, abs=5 * expected / 400)
    assert grey.std() == pytest.approx(expected, rel=0.02)
    many = expose(flat, Noise(photons=100.0), np.random.default_rng(0)).astype(float)
    assert many.std() == pytest.approx(np.sqrt(200.3 / 14000 + 0.7**2 + 1 / 12), rel=0.02)
    assert expose(flat + 100, Noise(), np.random.default_rng(0)).max() == 255


def test_speckle_is_new_in_each_frame_and_keeps_the_mean() -> None:
    plain = render([wall(1200.0)])
    grainy = render([wall(1200.0)], projection=replace(CRISP, speckle=0.06))
    lit = plain["lit"] - plain["dark"]
    bright = lit > 0.5 * lit.max()
    factors = {k: ((v - plain["dark"]) / lit)[bright] for k, v in grainy.items() if k == "lit"}
    assert factors["lit"].std() == pytest.approx(0.06, rel=0.05)
    assert factors["lit"].mean() == pytest.approx(1.0, abs=5 * 0.06 / np.sqrt(bright.sum()))
    total = grainy["bit00"] + grainy["bit00-inverse"] - grainy["dark"]
    assert np.corrcoef((total / plain["lit"])[bright], factors["lit"])[0, 1] < 0.1
    assert (grainy["dark"] == plain["dark"]).all()  # the room's light is no laser


def test_projector_out_of_focus_loses_contrast_near_by() -> None:
    def contrast(depth: float) -> float:
        images = render([wall(depth)], projection=replace(CRISP, defocus_stripes=2.0))
        difference = images["bit04"] - images["bit04-inverse"]
        return float(
            np.abs(difference[48:80]).mean() / (images["lit"] - images["dark"])[48:80].mean()
        )

    assert contrast(1000.0) > 0.9  # in focus, the finest bit
    assert contrast(600.0) < 0.7 * contrast(1000.0)


def test_camera_out_of_focus_blurs_what_is_near() -> None:
    image = np.zeros((40, 80), np.float32)
    image[:, 20] = image[:, 60] = 1.0
    off = np.zeros_like(image)
    off[:, :40] = 1.0
    optics = Optics(blur_px=0.6, defocus_px=2.0)
    result = blur(image, list_blurs(optics, off))[20]
    u = np.arange(80)
    near, far = result[:40] / result[:40].sum(), result[40:] / result[40:].sum()
    # the pixel itself is not part of the blur here: the line is one sample wide
    assert np.sqrt((near * (u[:40] - 20) ** 2).sum()) == pytest.approx(np.hypot(0.6, 2.0), rel=0.02)
    assert np.sqrt((far * (u[40:] - 60) ** 2).sum()) == pytest.approx(0.6, rel=0.05)


def test_vignetting_darkens_the_corners() -> None:
    images = render([wall(1200.0)], optics=replace(SHARP, vignetting=1.0))
    plain = render([wall(1200.0)])
    ratio = images["dark"] / plain["dark"]
    cosine = 1 / np.linalg.norm(CAMERA.directions(np.array([0.0, 0.0])))
    assert ratio[0, 0] == pytest.approx(cosine**4, rel=1e-5)
    assert ratio.max() == pytest.approx(1.0, abs=1e-4)


def furnished() -> Scene:
    """A wall, a ball that throws a shadow on it, a slanting board."""
    shading = ball([-150.0, -40.0, 1000.0], 120.0, resolution=200)
    board = Board(name="plain", kind="checkerboard", columns=6, rows=5, square_mm=50.0)
    places = np.array([[0, 0], [300, 0], [0, 250], [300, 250]], float)
    corner, down = np.array([20.0, -150, 900]), np.array([0, 250.0, 0])
    slanting = build_grid_surface(corner, np.array([280.0, 0, 110]), down)
    sheet = Surface(
        slanting.vertices,
        slanting.triangles,
        printed=make_print(board, 0, BoardMaking()).albedo,
        print_xy=places,
    )
    return Scene([wall(1500.0), shading, sheet])


def test_a_curved_surface_is_cast_ray_by_ray() -> None:
    scene, band = furnished(), view(SHARP).bands[0]
    ends = trace_band(scene, band, projector(), LAMPS)
    straight = scene.cast(band.rays.reshape(-1, 3)).depth.reshape(ends.depth.shape)
    assert ends.depth == pytest.approx(straight, abs=0.01)


def test_interpolation_is_bilinear() -> None:
    rng = np.random.default_rng(0)
    corners = rng.random((2, 4, 5), dtype=np.float32)
    shift = rng.random((3, 4, 2), dtype=np.float32)
    offsets = rng.random((6, 2), dtype=np.float32)
    even = rng.random((3, 4)) < 0.7
    values = np.full((2, 3, 4, 6), -1.0, np.float32)
    interpolate(corners, shift, offsets, even, values)
    x, y = np.moveaxis((offsets + shift[:, :, None]) % 1.0, -1, 0)
    a, b, c, d = (
        corners[:, r : r + 3, k : k + 4, None] for r, k in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    plain = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
    assert values[:, even] == pytest.approx(plain[:, even], abs=1e-6)
    assert (values[:, ~even] == -1.0).all()
