"""A person who sways, breathes and moves arms and head while frames are taken; skin, hair and cloth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from small_view import CAMERA, CRISP, LAMPS, projector, view, wall

from bodyscan.arrays import Array, Floats
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.simulation import SimulationSettings, compose_settings, simulate
from bodyscan.simulation.body import load_subject
from bodyscan.simulation.lamps import compute_highlight, shape_mm, spread_light
from bodyscan.simulation.living import LivingBody, animate, draw_signal, load_body, moves
from bodyscan.simulation.presets import SUBJECTS
from bodyscan.simulation.render import Moving, render_pair
from bodyscan.simulation.scene import Scene, Surface
from bodyscan.simulation.settings import Person, Skin

PROJECT = Path(__file__).parents[2]
SUBJECT = PROJECT / "data" / "subjects" / "man_average.ply"
STANDING = Person(subdivisions=0, **SUBJECTS["standing"])


def load_moving_body(person: Person) -> LivingBody:
    rng = np.random.default_rng(0)
    return animate(load_subject(SUBJECT, person, rng), person, rng)


@pytest.fixture(scope="module")
def living() -> LivingBody:
    return load_moving_body(STANDING)


def speeds(places: Array, step_ms: float) -> Array:
    """RMS over time, mm/s, of places (T, N, 3)."""
    moved = np.diff(places, axis=0) / (step_ms / 1000.0)
    return np.sqrt(np.mean(np.sum(moved**2, axis=-1), axis=0))


def test_a_wander_moves_as_fast_as_it_is_told_to() -> None:
    for seed in range(5):
        wander = draw_signal(7.0, 2, np.random.default_rng(seed), speed=True)
        path = np.array([wander.at(ms) for ms in np.arange(0, 600_000, 50.0)])
        # Ten minutes are ninety periods of the slowest wave.
        assert speeds(path[:, None], 50.0)[0] == pytest.approx(7.0, rel=0.05)
        still = draw_signal(7.0, 2, np.random.default_rng(seed), speed=False)
        path = np.array([still.at(ms) for ms in np.arange(0, 600_000, 50.0)])
        assert np.sqrt(np.mean(np.sum(path**2, axis=1))) == pytest.approx(7.0, rel=0.05)


def test_sway_is_a_pole_on_its_ankles() -> None:
    body = load_moving_body(Person(subdivisions=0, sway_mm_s=7.0))
    vertices = body.rest.vertices
    top, foot = int(np.argmax(vertices[:, 2])), int(np.argmin(vertices[:, 2]))
    middle = int(np.argmin(np.abs(vertices[:, 2] - 0.5 * vertices[top, 2])))
    path = np.array(
        [body.vertices(ms)[[top, middle, foot], :2] for ms in np.arange(0, 60_000, 200.0)]
    )
    head, half, sole = speeds(path, 200.0)
    assert head == pytest.approx(7.0, rel=0.2)  # a minute is nine periods of the slowest wave
    assert half == pytest.approx(head * (0.5 - 0.055) / (1.0 - 0.055), rel=0.03)
    assert sole == 0.0


def test_breath_comes_and_goes_on_chest_and_belly_alone() -> None:
    body = load_moving_body(Person(subdivisions=0, breath_mm=4.0))
    moments = np.linspace(0.0, 1000.0 * body.breath.period_s, 60, endpoint=False)
    path = np.array([body.vertices(ms) for ms in moments])
    reach = np.ptp(path[..., 0], axis=0)
    height = body.rest.vertices[:, 2] / body.rest.vertices[:, 2].max()
    assert reach.max() == pytest.approx(4.0, rel=0.15)  # its two places are added up
    assert 0.55 < height[np.argmax(reach)] < 0.78
    assert np.abs(np.mean(path, axis=0) - body.vertices(0.0, breathing=False)).max() < 1e-9
    still = (height < 0.4) | (height > 0.95)
    assert reach[still].max() < 0.05
    back = body.rest.vertices[:, 0] < np.percentile(body.rest.vertices[:, 0], 10)
    assert reach[back & (height > 0.5)].max() < 0.2


def test_arms_turn_about_shoulders_and_the_head_about_the_neck() -> None:
    body = load_moving_body(Person(subdivisions=0, arms_deg=0.5, head_deg=0.3))
    vertices = body.rest.vertices
    hands = [int(np.argmin(vertices[:, 1])), int(np.argmax(vertices[:, 1]))]
    crown = int(np.argmax(vertices[:, 2]))
    trunk = (np.abs(vertices[:, 1]) < 100) & (vertices[:, 2] < 1300)
    path = np.array([body.vertices(ms) for ms in np.arange(0, 40_000, 1000.0)])
    away = np.sqrt(np.mean(np.sum((path - vertices) ** 2, axis=-1), axis=0))
    arm = np.linalg.norm(vertices[hands[1]] - body.limbs[1].pivot)
    # Two of three axes turn it; the third is its own. Forty seconds are few periods.
    for hand in hands:
        assert away[hand] == pytest.approx(np.radians(0.5) * arm * np.sqrt(2 / 3), rel=0.5)
    assert 0.3 < away[crown] < 2.0
    assert away[trunk].max() == 0.0
    assert [joint.weights[hands[0]] for joint in body.limbs] == [1.0, 0.0, 0.0]


def test_what_has_no_limbs_or_no_chest_cannot_move(living: LivingBody) -> None:
    block = Surface(1000.0 * np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    for still in (block, replace(living.rest, vertices=living.rest.vertices * [0.0, 1.0, 1.0])):
        with pytest.raises(BadInput, match="no chest, arms and head"):
            animate(still, STANDING, np.random.default_rng(0))


def test_only_a_mannequin_stands_still() -> None:
    still = {name: moves(Person(**person)) for name, person in SUBJECTS.items()}
    assert still == {"mannequin": False, "standing": True, "restless": True, "child": True}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("person.breath=5", r"breath is not a setting \(did you mean 'breath_m?m?s?'"),
        ("persons.breath_mm=5", r"persons is not a setting \(did you mean 'person'"),
        ("person.breath_mm=deep", r"person.breath_mm: .*valid number.*deep"),
        ("pace.start=later", "pace.start: .*one-after-another"),
        ("breath_mm=5", "breath_mm is not a setting"),
        ("person.breath_mm", "person.breath_mm: Input should be a valid number"),
    ],
)
def test_a_wrong_change_is_named(change: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        compose_settings("mirror", changes=[change])


@pytest.mark.slow
def test_what_moves_is_seen_where_it_is_when_each_frame_is_taken() -> None:
    """A white square before a dark wall: frame by frame its image is that of a still one there."""
    square = wall(900.0, 300.0, albedo=0.8)
    behind = wall(1500.0, albedo=0.1)
    rays = view()

    def scene(x: float) -> Scene:
        return Scene([square.transform(RigidTransform(np.eye(3), np.array([x, 0.0, x]))), behind])

    def render(at: float, moving: Moving | None = None) -> dict[str, Floats]:
        rng = np.random.default_rng(1)
        return render_pair(scene(at), rays, projector(), LAMPS, CRISP, rng, moving=moving)

    places = {name: 5.0 * k for k, name in enumerate(render(0.0))}
    images = render(0.0, Moving(1, lambda frame: scene(places[frame]), 70.0))
    for frame, place in places.items():
        still = render(place)
        expected = still[frame]
        # The wall under the square's shadow is lit as where the square was at first.
        there = still["dark"] > 5.0  # ambient 8 on the square, 1 on the wall
        assert there.any()
        np.testing.assert_allclose(images[frame][there], expected[there], atol=1e-4)
        assert np.count_nonzero((images["dark"] > 5.0) != there) > 0 or frame == "dark"


@pytest.mark.slow
def test_a_scan_of_a_living_person_with_its_truth(tmp_path: Path) -> None:
    rig = PROJECT / "rigs" / "three-pole-12.yaml"
    settings = replace(SimulationSettings(), person=STANDING)
    simulate(rig, tmp_path, subject=SUBJECT, scale=0.05, settings=settings, board_shots=0)
    truth = json.loads((tmp_path / "truth" / "truth.json").read_text())
    body = load_body(truth["motion"], tmp_path / "truth" / "body.npz")
    moment = truth["motion"]["moment_ms"]

    def surface(name: str) -> Array:
        path = tmp_path / "truth" / f"{name}.ply"
        return np.asarray(o3d.io.read_triangle_mesh(str(path)).vertices)

    # Weights are kept to seven digits: a micrometre over limbs that move by millimetres.
    assert np.abs(surface("subject") - body.vertices(moment)).max() < 1e-4
    mean = body.vertices(moment, breathing=False)
    assert np.abs(surface("subject-mean-breath") - mean).max() < 1e-4
    # Twelve pairs of lit, dark, five bits and their inverses, 120 a second.
    assert moment == pytest.approx(12 * 12 / 120 * 1000 / 2)
    first, last = (np.array(truth["pairs"][name]["swayed_from_still"]) for name in ("p1-1", "p3-4"))
    assert np.abs(first - last)[:3, 3].max() > 0.01


WOMAN = Path(__file__).parents[2] / "data" / "subjects" / "woman_average.ply"
SPREADS = Skin(spread_mm=1.0, stays=0.07)


def bright_point() -> Floats:
    light = np.zeros((201, 201), np.float32)
    light[100, 100] = 1.0
    return light


def test_light_spreads_as_burley_has_it() -> None:
    """Of the profile (exp(-r/d) + exp(-r/3d)) / (8 pi d r) the mean square radius is 14 d^2."""
    light, depth = bright_point(), np.full((201, 201), 1000.0, np.float32)
    share = np.ones_like(depth)
    alpha = 4000.0  # 4 px/mm, so that a pixel is small against the profile
    spread = spread_light(light, share, depth, alpha, SPREADS)
    assert spread.sum() == pytest.approx(1.0, abs=1e-4)  # none is lost
    stayed = light * 0.07
    v, u = np.indices(light.shape) - 100
    r2 = (u**2 + v**2) / 4.0**2
    entered = (spread - stayed) / 0.93
    # Cut off at 18 d, beyond which lies a five-hundredth of the light, but a twentieth of this.
    assert np.sum(entered * r2) == pytest.approx(14.0 * shape_mm(SPREADS) ** 2, rel=0.08)
    assert spread[100, 100] > 0.07


def test_farther_away_it_spreads_over_fewer_pixels() -> None:
    light = bright_point()
    depth = np.full((201, 201), 1500.0, np.float32)
    depth[:, :80] = 750.0
    pair = np.roll(light, -60, axis=1) + np.roll(light, 60, axis=1)
    spread = spread_light(pair, np.ones_like(depth), depth, 2000.0, SPREADS)
    near, far = spread[100, 40], spread[100, 160]
    # The profile is a pole: in its middle twice as wide is half as bright. A 14th stays.
    assert near - 0.07 == pytest.approx(0.55 * (far - 0.07), rel=0.1)


def test_light_does_not_leave_skin_for_cloth() -> None:
    light = np.ones((60, 60), np.float32)
    share = np.zeros_like(light)
    share[:, :30] = 1.0
    depth = np.full_like(light, 1000.0)
    spread = spread_light(light, share, depth, 2000.0, SPREADS)
    np.testing.assert_allclose(spread, 1.0, atol=1e-5)
    light[:, 30:] = 0.0
    np.testing.assert_allclose(spread_light(light, share, depth, 2000.0, SPREADS), light, atol=1e-5)
    assert spread_light(light, 0 * share, depth, 2000.0, SPREADS) is light
    assert spread_light(light, share, depth, 2000.0, Skin()) is light


def test_gloss_is_where_a_mirror_would_show_the_light() -> None:
    skin = Skin(gloss=0.8, gloss_power=30.0)
    point, towards = np.array([[0.0, 0.0, 1000.0]]), np.array([[300.0, 0.0, -1000.0]])
    view_direction = np.array([0.0, 0.0, -1.0])
    half = view_direction + towards[0] / np.linalg.norm(towards)
    assert compute_highlight(point, towards, half[None], skin)[0] == pytest.approx(0.8)
    tilted = half + [0.6, 0.0, 0.0]
    assert compute_highlight(point, towards, tilted[None], skin)[0] < 0.4


def rendered(skin: Skin, share: float) -> dict[str, Floats]:
    flat = wall(900.0, albedo=0.5)
    covered: Surface = replace(flat, skin=np.full(len(flat.vertices), share))
    lamps = replace(LAMPS, skin=skin)
    rng = np.random.default_rng(0)
    return render_pair(Scene([covered]), view(), projector(), lamps, CRISP, rng)


def test_images_of_skin() -> None:
    plain = rendered(Skin(), 1.0)
    finest = max(name for name in plain if name.startswith("bit") and len(name) == 5)

    def contrast(images: dict[str, Floats]) -> Array:
        middle = images[finest][40:90, 40:120].astype(float)
        return middle.std() / middle.mean()

    # Stripes are some 4 px wide, a pixel 5 mm: only a long free path blurs them.
    deep = Skin(spread_mm=10.0)
    assert contrast(rendered(deep, 1.0)) < 0.9 * contrast(plain)
    assert contrast(rendered(deep, 0.0)) == contrast(plain)
    shining = rendered(Skin(gloss=0.5, gloss_power=5.0), 1.0)
    assert (shining["lit"] - plain["lit"]).max() > 10.0
    np.testing.assert_array_equal(shining["dark"], plain["dark"])
    assert CAMERA.width == plain["lit"].shape[1]


def test_hair_and_shorts_are_dark_and_let_no_light_in() -> None:
    person = Person(subdivisions=1, skin_variation=0.0)

    def dressed(skin: Skin) -> Surface:
        return load_subject(WOMAN, person, np.random.default_rng(0), skin)

    plain = dressed(Skin())
    assert plain.skin is None
    worn = dressed(Skin(spread_mm=0.7, hair=0.03, shorts=0.05, moles=40, mottling=0.03))
    assert isinstance(worn.albedo, np.ndarray)
    assert worn.skin is not None
    z = plain.vertices[:, 2] / plain.vertices[:, 2].max()
    hair, cloth = worn.albedo == 0.03, worn.albedo == 0.05
    assert z[hair].min() > 0.88
    assert hair[np.argmax(z)]
    face = (z > 0.89) & (z < 0.93) & (plain.vertices[:, 0] > 40)
    assert not hair[face].any()
    assert 0.4 < z[cloth].min() < z[cloth].max() < 0.57
    assert set(np.unique(worn.skin[hair | cloth])) == {0.0}
    assert set(np.unique(worn.skin[~(hair | cloth)])) == {1.0}
    rough = np.linalg.norm(worn.vertices - plain.vertices, axis=1)
    assert rough[~hair].max() == 0.0
    assert rough[hair].mean() == pytest.approx(np.sqrt(2 / np.pi), rel=0.1)  # mean of |N(0, 1)|
    skin = worn.albedo[~(hair | cloth)]
    assert 0.02 < np.std(skin[skin > 0.5]) / np.mean(skin) < 0.05
    assert (skin < 0.4).any()  # moles
