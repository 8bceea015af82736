"""Measurements of a made body and of a subject's surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from made_bodies import cylinder, ellipsoid, mesh_of
from standing_body import hanging, standing_body, trunk_tape

from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.changes import MeasureChanges
from bodyscan.measurement.measurements import Slice, measure, parse_heights
from bodyscan.mesh.body import DARK_CLOTH, HAIR, SKIN, BodyMesh, BreathAt
from bodyscan.report.measurement_table import make_measurements_document, tables

SUBJECT = Path(__file__).parents[2] / "data" / "subjects" / "woman_average.ply"


@pytest.fixture(scope="module")
def subject() -> BodyMesh:
    """Facing x, mm, made smooth as the simulator does."""
    read = o3d.io.read_triangle_mesh(str(SUBJECT)).subdivide_loop(1)
    x, y, z = 1000.0 * np.asarray(read.vertices).T
    return mesh_of(np.stack([-y, x, z], axis=-1), np.asarray(read.triangles))


def turned(body: BodyMesh, degrees: float, shift: list[float]) -> BodyMesh:
    turn = RigidTransform.from_rotation_vector([0.0, 0.0, np.radians(degrees)], shift)
    return mesh_of(turn.apply(body.vertices), body.faces)


def tape_mm(level: Slice, part: str) -> float:
    girth = level.find_girth(part)
    assert girth is not None
    return girth.tape_mm


def test_the_subject_measures_what_its_description_says(subject: BodyMesh) -> None:
    # data/subjects/README.md: 1.633 m, hip 1014 mm (at 800 mm), waist 727 mm (the narrowest).
    found = measure(subject, [800.0])
    assert found.stature_mm == pytest.approx(1633.0, abs=2.0)
    assert tape_mm(found.slices[0], "trunk") == pytest.approx(1014.0, abs=2.0)
    waists = measure(subject, np.arange(980.0, 1120.0, 5.0).tolist()).slices
    assert min(tape_mm(level, "trunk") for level in waists) == pytest.approx(727.0, abs=2.0)
    assert found.measured == 1.0


def test_parts_by_height(subject: BodyMesh) -> None:
    shins, hips, breast = measure(subject, [350.0, 850.0, 1150.0]).slices
    assert {girth.part for girth in shins.girths} == {"left leg", "right leg"}
    for level in (hips, breast):
        assert {girth.part for girth in level.girths} == {"left arm", "right arm", "trunk"}
    left, right = shins.find_girth("left leg"), shins.find_girth("right leg")
    assert left is not None
    assert right is not None
    assert left.centre_mm[1] > 0 > right.centre_mm[1]
    assert left.tape_mm == pytest.approx(right.tape_mm, abs=1.0)  # the subject is symmetric
    assert breast.find_girth("left leg") is None


@pytest.mark.parametrize("degrees", [-60.0, 25.0, 80.0, 180.0])
def test_how_the_subject_stands_changes_nothing(subject: BodyMesh, degrees: float) -> None:
    straight = measure(subject, [350.0, 900.0])
    askew = measure(turned(subject, degrees, [120.0, -80.0, 0.0]), [350.0, 900.0])
    assert askew.stature_mm == pytest.approx(straight.stature_mm, abs=1e-6)
    assert askew.volume_l == pytest.approx(straight.volume_l, rel=1e-9)
    for one, other in zip(straight.slices, askew.slices, strict=True):
        assert [g.part for g in one.girths] == [g.part for g in other.girths]
        for a, b in zip(one.girths, other.girths, strict=True):
            assert b.tape_mm == pytest.approx(a.tape_mm, abs=1e-6)
            assert b.width_mm == pytest.approx(a.width_mm, abs=0.01)
    turn = askew.rig_from_body.rotation @ straight.rig_from_body.rotation.T
    assert np.degrees(np.arctan2(turn[1, 0], turn[0, 0])) == pytest.approx(degrees, abs=0.01)


def test_volume_and_crown_of_an_ellipsoid_and_area_of_a_cylinder() -> None:
    vertices, faces = ellipsoid((100.0, 200.0, 800.0), (0.0, 0.0, 800.0))
    filled = vertices[faces].mean(axis=1)[:, 2] > 1500.0
    found = measure(mesh_of(vertices, faces, filled))
    assert found.volume_l == pytest.approx(4 / 3 * np.pi * 0.1 * 0.2 * 0.8 * 1e3, rel=1e-3)
    assert found.stature_mm == pytest.approx(1600.0)
    assert found.stature_measured == 0.0
    assert 0.9 < found.measured < 1.0
    assert len(found.slices) == 15  # every 100 mm below 1600
    found = measure(mesh_of(*cylinder(100.0, 0.0, 1000.0)))
    assert found.area_m2 == pytest.approx(2 * np.pi * (0.1 * 1.0 + 0.01), rel=1e-4)


def test_girths_are_those_at_mean_breath_and_say_how_well_it_is_known() -> None:
    still = mesh_of(*cylinder(100.0, 0.0, 1000.0))
    around = still.vertices * [1.0, 1.0, 0.0]
    normals = (around / np.maximum(np.linalg.norm(around, axis=1), 1e-9)[:, None]).astype("f4")
    way, sigma = (np.full(len(normals), mm, np.float32) for mm in (-2.0, 0.5))
    full = replace(still, normals=normals, breath=BreathAt(way, sigma))
    (mean,) = measure(full, [500.0]).slices
    (moment,) = measure(full, [500.0], mean_breath=False).slices
    assert tape_mm(mean, "trunk") == pytest.approx(2 * np.pi * 98.0, rel=1e-3)
    assert tape_mm(moment, "trunk") == pytest.approx(2 * np.pi * 100.0, rel=1e-3)
    sigmas = [level.girths[0].breath_sigma_mm for level in (mean, moment)]
    assert sigmas == pytest.approx([np.pi, np.pi], rel=0.02)
    assert measure(full).at_mean_breath
    assert not measure(still).at_mean_breath


def test_no_body_at_that_height(subject: BodyMesh) -> None:
    with pytest.raises(BadInput, match="no body at a height of 2500"):
        measure(subject, [2500.0])
    corner = mesh_of(np.vstack([np.zeros(3), 90.0 * np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3]]))
    assert measure(corner).slices == ()


def test_table_and_document_say_the_same(subject: BodyMesh) -> None:
    found = measure(subject, [900.0])
    said = make_measurements_document(found, {"subject": "s1", "calibration_id": "c", "when": None})
    assert said["stature_mm"] == found.stature_mm
    assert said["slices"][0]["girths"][-1]["tape_mm"] == tape_mm(found.slices[0], "trunk")
    assert [table.row_count for table in tables(found)] == [4, 3]
    assert tape_mm(found.slices[0], "trunk") in [one["tape_mm"] for one in found.to_records()]
    since = MeasureChanges("s2", None, True, ())  # by whose name `forget` finds it too
    assert make_measurements_document(found, {}, since)["compared_with"] == "s2"


def test_of_a_body_seen_from_the_knees_up_the_slices_there_are_are_given(subject: BodyMesh) -> None:
    upper = mesh_of(np.maximum(subject.vertices, [-1e4, -1e4, 430.0]), subject.faces)
    heights = [one.height_mm for one in measure(upper).slices]
    assert heights[0] == 500.0
    assert heights[-1] == 1600.0
    with pytest.raises(BadInput, match="no body at a height of 100 mm") as error:
        measure(upper, [100.0])
    assert "Give heights between 430 and 1632 mm" in str(error.value)


def test_a_girth_that_touches_another_part_is_a_range() -> None:
    """A trunk with arms against it, measured all round: what lies between was not."""
    found = measure(mesh_of(*standing_body(hanging(0.0))), [1000.0])
    (trunk,) = (girth for girth in found.slices[0].girths if girth.part == "trunk")
    assert set(trunk.touches) == {"left arm", "right arm"}
    low, high = trunk.tape_range_mm
    assert low < trunk_tape() < high
    assert high - low < 60.0  # with the arms it has 200 mm more
    assert trunk.measured < 0.99


def test_every_girth_has_the_width_of_noise_and_breath() -> None:
    still = mesh_of(*cylinder(100.0, 0.0, 1000.0))
    sigma = np.full(len(still.vertices), 0.3, np.float32)
    for level in (1.0, 0.5):  # of the normals: a slope of 60 degrees moves twice as far in a slice
        noisy = replace(still, sigma_mm=sigma, normals=np.float32(level) * still.normals)
        (girth,) = measure(noisy, [500.0]).slices[0].girths
        width = np.ptp([girth.tape_range_mm, girth.girth_range_mm], axis=1)
        assert width == pytest.approx(2.0 * 1.96 * np.pi * 0.3 / level, rel=0.02)
    (girth,) = measure(replace(still, sigma_mm=1000.0 * sigma), [500.0]).slices[0].girths
    assert (girth.girth_range_mm[0], girth.tape_range_mm[0]) == (0.0, 0.0), "no girth is negative"


@pytest.mark.parametrize("degrees", [90.0, 180.0])
def test_left_is_the_bodys_left_however_it_faces(degrees: float) -> None:
    vertices, faces = standing_body(hanging(25.0))
    lifted = vertices + np.where(vertices[:, 1:2] > 330.0, [0.0, 0.0, 100.0], 0.0)
    found = measure(turned(mesh_of(lifted, faces), degrees, [0.0, 0.0, 0.0]), [740.0])
    assert found.facing_known
    parts = {girth.part for girth in found.slices[0].girths}
    assert parts == {"left leg", "right leg", "right arm"}


def test_heights_are_numbers_with_commas_between() -> None:
    assert parse_heights("800,1050.5") == [800.0, 1050.5]
    with pytest.raises(BadInput, match="'800;1050' is not a list of heights"):
        parse_heights("800;1050")
    with pytest.raises(BadInput, match=r"is 5 the decimals of 1050\?") as asked:
        parse_heights("1050,5")
    assert "1050.5" in asked.value.remedy


@pytest.mark.parametrize(
    ("skin", "crown"), [(1.0, "skin"), (0.6, "skin"), (0.45, "hair"), (0.0, "hair")]
)
def test_a_crown_is_what_more_than_half_of_it_is(skin: float, crown: str) -> None:
    body = mesh_of(*cylinder(100.0, 0.0, 1000.0))
    across = body.vertices[:, 1]
    regions = np.where(across < np.quantile(across, skin), SKIN, HAIR).astype(np.uint8)
    found = measure(replace(body, regions=regions), [500.0])
    assert found.crown == crown
    thirds = np.digitize(np.arctan2(body.vertices[:, 1], body.vertices[:, 0]), [-1.05, 1.05])
    three = np.array([SKIN, HAIR, DARK_CLOTH])[thirds].astype(np.uint8)
    assert measure(replace(body, regions=three), [500.0]).crown == "unsure"
    assert measure(body, [500.0]).crown is None, "of what it is nothing is known"
