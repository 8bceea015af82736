"""What is carried, and who lies, is asked about; people of any size are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from ray_cast_scan import ROOT, Truth, load_body

from bodyscan.fusion.proportions import find_loads, odd_proportions
from bodyscan.mesh.body import BodyMesh

SUBJECTS = ("woman_average", "man_average")
SIZES = {"as they are": (1, 1, 1), "a child": (0.7, 0.7, 0.7), "2 m": (1.2, 1.2, 1.2)}
SIZES |= {"heavy": (1.4, 1.3, 1.0), "thin": (0.8, 0.85, 1.0)}


@pytest.fixture(scope="module", params=SUBJECTS)
def body(request: pytest.FixtureRequest) -> Truth:
    return load_body(ROOT / "data" / "subjects" / f"{request.param}.ply", subdivisions=0)


def asked(*parts: Truth, filled_above: float = np.inf) -> str:
    found = odd_proportions(meshed(*parts, filled_above=filled_above))
    return " | ".join(f"{grade}: {said}" for grade, said in found)


def meshed(*parts: Truth, filled_above: float = np.inf) -> BodyMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, starts, strict=False)])
    none = np.zeros(len(vertices), np.float32)
    return BodyMesh(
        vertices,
        faces,
        np.zeros_like(vertices),
        none.astype(np.uint8),
        none,
        vertices[faces, 2].min(axis=1) > filled_above,
    )


def box(size: tuple[float, float, float], middle: tuple[float, float, float]) -> Truth:
    made = o3d.geometry.TriangleMesh.create_box(*size)
    vertices = np.asarray(made.vertices) - 0.5 * np.array(size) + middle
    return Truth(vertices, np.asarray(made.triangles).astype(np.int64))


@pytest.mark.parametrize("size", SIZES)
def test_people_of_any_size_are_asked_nothing(body: Truth, size: str) -> None:
    sized = Truth(body.vertices * SIZES[size], body.faces)
    assert asked(sized) == ""
    assert find_loads(meshed(sized)) == ()


def test_hands_that_begin_where_hips_widen_are_no_bag() -> None:
    """As of an average man in whose scan the thighs were joined: 17 % and two hands of 3200 mm2."""
    legs = [box((150.0, 180.0, 720.0), (0.0, side, 360.0)) for side in (-100.0, 100.0)]
    hips = box((200.0, 300.0, 140.0), (0.0, 0.0, 790.0))
    trunk = box((235.0, 300.0, 900.0), (0.0, 0.0, 1310.0))
    hands = [box((80.0, 40.0, 400.0), (0.0, side, 1060.0)) for side in (-250.0, 250.0)]
    assert asked(*legs, hips, trunk, *hands) == ""
    bag = box((400.0, 40.0, 400.0), (0.0, 250.0, 1060.0))
    assert "carried" in asked(*legs, hips, trunk, hands[0], bag)


def test_a_load_begins_above_the_crotch_whose_own_section_is_half_of_the_thighs() -> None:
    """Where thighs meet, one section goes round both before the hips begin, 27 % larger."""
    step = 1755.0 / 54.0
    legs = [box((150.0, 180.0, 720.0), (0.0, side, 360.0)) for side in (-100.0, 100.0)]
    for high, loads in ((step, 0), (3.0 * step, 1)):
        meet = box((185.0, 300.0, high), (0.0, 0.0, 720.0 + 0.5 * high))
        rest = 1755.0 - 720.0 - high
        trunk = box((235.0, 300.0, rest), (0.0, 0.0, 1755.0 - 0.5 * rest))
        assert len(find_loads(meshed(*legs, meet, trunk))) == loads


def test_a_trunk_between_two_arms_is_not_on_two_legs() -> None:
    """Beside which arms hang from the crotch to above the load."""
    legs = [box((150.0, 180.0, 720.0), (0.0, side, 360.0)) for side in (-100.0, 100.0)]
    trunk = box((235.0, 300.0, 1035.0), (0.0, 0.0, 1237.5))
    arms = [box((90.0, 90.0, 900.0), (0.0, side, 1150.0)) for side in (-260.0, 260.0)]
    assert find_loads(meshed(*legs, trunk, *arms)) == ()
    lower, upper = (
        box((235.0, 300.0, high), (0.0, 0.0, middle))
        for high, middle in ((300.0, 870.0), (535.0, 1487.5))
    )
    pack = box((420.0, 300.0, 200.0), (0.0, 0.0, 1120.0))
    loads = find_loads(meshed(*legs, lower, pack, upper, *arms))
    assert [round(load.low_mm, -2) for load in loads] == [1000.0]


def prism(outline: list[tuple[float, float]], low: float, high: float) -> Truth:
    """The sides of an upright prism; side k gives faces 2 k and 2 k + 1."""
    below = np.array([(*corner, low) for corner in outline])
    here = np.arange(len(outline))
    beyond = np.roll(here, -1)
    above, opposite = here + len(outline), beyond + len(outline)
    faces = np.stack([here, beyond, opposite, here, opposite, above], axis=1).reshape(-1, 3)
    return Truth(np.concatenate([below, below + [0.0, 0.0, high - low]]), faces)


@pytest.mark.parametrize("filled", [True, False])
def test_thighs_that_filling_joined_are_still_two_legs(filled: bool) -> None:
    """As of a heavy man, above whose crotch hips and belly widen by 28 % in 30 mm; what was measured
    to be one piece is asked about."""
    legs = [box((150.0, 180.0, 700.0), (0.0, side, 350.0)) for side in (-100.0, 100.0)]
    right = [
        (20.0, 10.0),
        (75.0, 10.0),
        (75.0, 190.0),
        (-75.0, 190.0),
        (-75.0, 10.0),
        (-20.0, 10.0),
    ]
    thighs = prism([*right, *((-x, -y) for x, y in right)], 700.0, 800.0)
    trunk = box((235.0, 300.0, 960.0), (0.0, 0.0, 1280.0))
    mesh = meshed(thighs, *legs, trunk)
    webs = np.isin(np.arange(len(mesh.faces)), [10, 11, 22, 23])
    mesh = replace(mesh, filled=webs & filled)
    said = [question for _, question in odd_proportions(mesh)]
    assert bool(said) is not filled
    assert bool(find_loads(mesh)) is not filled


@pytest.mark.parametrize(
    ("size", "middle"),
    [
        ((160.0, 300.0, 420.0), (-200.0, 0.0, 0.72)),
        ((300.0, 100.0, 300.0), (0.0, 450.0, 0.43)),
    ],
    ids=["backpack", "bag in a hand"],
)
def test_what_is_carried_is_asked_about(
    body: Truth, size: tuple[float, float, float], middle: tuple[float, float, float]
) -> None:
    height = middle[2] * float(body.vertices[:, 2].max())
    said = asked(body, box(size, (*middle[:2], height)))
    assert said.startswith("usable: the body's section changes by")
    assert "carried" in said


def test_a_chest_that_is_deeper_than_wide_is_asked_about(body: Truth) -> None:
    """A round bag on the back, of which no section shows where it begins."""
    top = float(body.vertices[:, 2].max())
    share = body.vertices[:, 2] / top
    trunk = np.abs(body.vertices[:, 1]) < 0.12 * top
    deeper = 1.0 + 0.8 * np.exp(-(((share - 0.7) / 0.08) ** 2)) * trunk
    vertices = body.vertices * np.stack([deeper, np.ones_like(deeper), np.ones_like(deeper)], 1)
    bulging = Truth(vertices, body.faces)
    assert "times as deep as wide" in asked(bulging)
    # Above the armpits there is no section between two arms that shows where it ends.
    assert max(load.high_mm for load in find_loads(meshed(bulging))) == pytest.approx(0.86 * top)


def with_backpack(body: Truth, low: float, high: float) -> Truth:
    """On the back, between two heights, 150 mm deep, in one surface with it."""
    x, y, z = body.vertices.T
    top = float(z.max())
    back = (x < 0.0) & (np.abs(y) < 0.1 * top) & (low * top < z) & (z < high * top)
    return Truth(body.vertices - np.outer(back, [150.0, 0.0, 0.0]), body.faces)


def test_a_trunk_holds_a_backpack_from_where_it_begins_to_where_it_ends(body: Truth) -> None:
    top = float(body.vertices[:, 2].max())
    loads = find_loads(meshed(with_backpack(body, 0.58, 0.68)))
    assert min(load.low_mm for load in loads) == pytest.approx(0.58 * top, abs=0.03 * top)
    assert max(load.high_mm for load in loads) == pytest.approx(0.68 * top, abs=0.03 * top)
    loads = find_loads(meshed(with_backpack(body, 0.6, 0.85)))
    # Shoulders narrow by themselves: up to the neck nobody can tell where it ends.
    assert max(load.high_mm for load in loads) == pytest.approx(0.86 * top)


def test_what_hangs_below_the_crotch_is_a_load_from_there_on(body: Truth) -> None:
    top = float(body.vertices[:, 2].max())
    (load,) = find_loads(meshed(with_backpack(body, 0.4, 0.62)))
    # Crotches of adults lie at 0.44 to 0.49, and sections are 0.02 apart.
    assert 0.44 < load.low_mm / top < 0.51
    assert load.high_mm == pytest.approx(0.62 * top, abs=0.03 * top)


def test_a_bag_in_a_hand_is_no_load_of_the_trunk(body: Truth) -> None:
    height = 0.5 * float(body.vertices[:, 2].max())
    assert find_loads(meshed(body, box((300.0, 100.0, 300.0), (0.0, 450.0, height)))) == ()


def test_a_section_that_was_not_measured_hides_no_jump(body: Truth) -> None:
    """Where a backpack begins its underside was seen by nobody, as in a scan by three poles."""
    top = float(body.vertices[:, 2].max())
    mesh = meshed(with_backpack(body, 0.6, 0.85))
    centre = mesh.vertices[mesh.faces, 2].mean(axis=1) / top
    hidden = replace(mesh, filled=np.abs(centre - 0.6) < 0.015)
    assert min(load.low_mm for load in find_loads(hidden)) < 0.6 * top


def test_who_lies_is_asked(body: Truth) -> None:
    x, y, z = body.vertices.T
    lying = np.stack([z, y, x - x.min()], axis=1)
    assert "does the person lie" in asked(Truth(lying, body.faces[:, ::-1]))


def test_what_was_made_up_is_asked_nothing(body: Truth) -> None:
    """A section that fillings close may be of any size: that it is filled is said elsewhere."""
    top = float(body.vertices[:, 2].max())
    pack = box((160.0, 300.0, 420.0), (-200.0, 0.0, 0.72 * top))
    assert asked(body, pack, filled_above=0.55 * top) == ""
