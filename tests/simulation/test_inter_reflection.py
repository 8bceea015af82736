"""Light between surfaces against form factors that are known in closed form."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from small_view import CRISP, LAMPS, projector, view, wall

from bodyscan.simulation.inter_reflection import light_facets
from bodyscan.simulation.lamps import Lamps
from bodyscan.simulation.projector import PinholeProjector
from bodyscan.simulation.render import render_pair
from bodyscan.simulation.scene import Hits, Scene, Surface, grid_surface
from bodyscan.simulation.settings import InterReflection

PLAIN = Lamps(laser_grey=200.0, ambient_grey=10.0, reach_mm=100.0, focus_mm=100.0)
LONG, DEEP, CREASE_Z = 900.0, 60.0, 500.0


def lamp(reach: float = 10.0) -> PinholeProjector:
    """All that lies before the origin is lit, by 8 stripes."""
    return PinholeProjector(8, np.eye(3), np.zeros(3), -reach, reach, 1e9)


def groove(half_angle: float) -> list[Surface]:
    """Two long plates that meet in a crease along y and open towards the camera."""
    corner, down = np.array([0.0, -LONG / 2, CREASE_Z]), np.array([0.0, LONG, 0.0])
    sides = [
        DEEP * np.array([sign * np.sin(half_angle), 0, -np.cos(half_angle)]) for sign in (-1, 1)
    ]
    return [grid_surface(corner, side, down, albedo=0.5) for side in sides]


def on_right_plate(x: np.ndarray, half_angle: float) -> Hits:
    """Places at distances x (N,) from the crease, half-way along it."""
    way = np.array([np.sin(half_angle), 0.0, -np.cos(half_angle)])
    points = (np.array([0.0, 0.0, CREASE_Z]) + x[:, None] * way).astype(np.float32)
    normal = np.array([[np.cos(half_angle), 0.0, np.sin(half_angle)]], np.float32)
    whole = np.ones(len(x), np.float32)
    return Hits(
        points[:, 2],
        points,
        np.repeat(normal, len(x), 0),
        whole,
        whole.astype(np.uint32),
        0 * whole,
        np.repeat(normal, len(x), 0),
        np.zeros((len(x), 2), np.float32),
    )


@pytest.mark.parametrize("opening_deg", [60.0, 90.0])
def test_a_groove_lights_itself_as_crossed_strings_say(opening_deg: float) -> None:
    """From a place at x to a plate 0..L at angle phi, Hottel: (1 + (L cos phi - x) / r) / 2, r the
    distance to its rim."""
    phi = np.radians(opening_deg)
    facets = light_facets(Scene(groove(phi / 2)), lamp(), PLAIN, 10.0)
    left = (facets.middles[:, 0] < 0).astype(np.float32)
    x = np.array([20.0, 25.0, 30.0, 40.0, 55.0])
    found = facets.irradiance(on_right_plate(x, phi / 2), left[None])[0]
    rim = np.sqrt(x**2 + DEEP**2 - 2 * x * DEEP * np.cos(phi))
    # Two facets off the crease a disc is a square to 2 %; facets are cut unevenly at the rims, and
    # the ends of the plates, 450 mm away, lack less than 1 %.
    assert found == pytest.approx((1 + (DEEP * np.cos(phi) - x) / rim) / 2, rel=0.04)


def test_a_hollow_ball_lights_itself_evenly() -> None:
    """On a sphere every form factor is an area over 4 pi R^2: what the lamp in the middle throws on
    one half comes back to all places alike, lit or not."""
    radius, albedo = 100.0, 0.6
    mesh = o3d.geometry.TriangleMesh.create_sphere(radius, resolution=40)
    scene = Scene([Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles), albedo)])
    facets = light_facets(scene, lamp(1e6), PLAIN, 15.0)
    radiosity = facets.radiosity(np.ones(len(facets.s), np.float32))
    ways = np.random.default_rng(0).standard_normal((200, 3)).astype(np.float32)
    found = facets.irradiance(scene.cast(ways), radiosity[None])[0]
    expected = albedo * PLAIN.laser_grey * (PLAIN.reach_mm / radius) ** 2 / 2
    # A tenth of a place's light comes from the facets next to it, whose discs are good to a third.
    assert found.mean() == pytest.approx(expected, rel=0.03)
    assert found == pytest.approx(np.full(200, expected), rel=0.12)


def test_what_stands_between_keeps_the_light_away() -> None:
    half = np.radians(45.0)
    x = np.array([25.0, 40.0])
    screen = grid_surface(
        np.array([0.0, -LONG / 2, CREASE_Z]), np.array([0, 0, -200.0]), np.array([0, LONG, 0])
    )
    for surfaces, expected in (groove(half), None), ([*groove(half), screen], 0.0):
        facets = light_facets(Scene(surfaces), lamp(), PLAIN, 15.0)
        plates = np.abs(facets.middles[:, 0] / (CREASE_Z - facets.middles[:, 2]) + 1) < 1e-3
        found = facets.irradiance(on_right_plate(x, half), plates[None].astype(np.float32))[0]
        assert (found > 0.2).all() if expected is None else (found == expected).all()


@pytest.mark.slow
def test_images_with_light_between_surfaces() -> None:
    """Off, they are as they were to the last bit; on, all light still adds up and some is added."""
    side = grid_surface(
        np.array([-250.0, -200, 900]), np.array([0, 0, 300.0]), np.array([0, 400.0, 0]), albedo=0.8
    )
    scene = Scene([wall(1200.0, 700.0, albedo=0.7), side])

    def images(chosen: InterReflection | None) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(0)
        return render_pair(scene, view(), projector(), LAMPS, CRISP, rng, inter_reflection=chosen)

    plain, off, on = images(None), images(InterReflection()), images(InterReflection(60.0))
    assert all((plain[name] == off[name]).all() for name in plain)
    assert (on["dark"] == plain["dark"]).all()
    more = on["lit"] - plain["lit"]
    assert (more >= -1e-3).all()
    assert more.max() > 2.0
    for k in range(5):
        total = on[f"bit{k:02d}"] + on[f"bit{k:02d}-inverse"] - on["dark"]
        assert total == pytest.approx(on["lit"], abs=2e-3)
