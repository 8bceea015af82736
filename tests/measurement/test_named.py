"""Measures by name: bodies of known landmarks, with surface that the template's shapes cannot make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_bodies import ellipsoid, mesh_of
from made_registered import TEMPLATE, hide, make_body, register_exactly

from bodyscan.body_model.registered import RegisteredBody
from bodyscan.errors import BadInput
from bodyscan.export.scan import transform_mesh
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.changes import find_changes
from bodyscan.measurement.named import measure_by_name, read_definitions, take_measures
from bodyscan.measurement.sections import UP, BodySections
from bodyscan.mesh.body import BodyMesh


def scanned(body: RegisteredBody, turn_deg: float) -> BodyMesh:
    """The mesh of a scan: armpits, crotch and soles were not seen, and it may face anywhere."""
    vertices = body.fitted.vertices
    hidden = TEMPLATE.hidden | (vertices[:, 2] < 4.0)
    for name in ("left axilla", "right axilla", "crotch"):
        hidden |= np.linalg.norm(vertices - vertices[TEMPLATE.landmarks[name]], axis=1) < 35.0
    turn = RigidTransform.from_rotation_vector([0.0, 0.0, np.radians(turn_deg)], np.zeros(3))
    return transform_mesh(hide(body, hidden).mesh, turn)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "turn_deg"), [(1, 0.0), (2, 140.0)])
def test_measures_of_bodies_that_the_shapes_cannot_make(seed: int, turn_deg: float) -> None:
    body = register_exactly(*make_body(seed))
    named, true = measure_by_name(scanned(body, turn_deg)), take_measures(body)
    off = {n: m.mm - true.measures[n].mm for n, m in named.measures.items()}
    lengths = [abs(off[n]) for n, m in true.measures.items() if m.kind in ("distance", "height")]
    assert np.median(lengths) < 5.0
    assert np.quantile(lengths, 0.9) < 15.0
    assert np.mean([abs(off[name]) for name in off if "girth" in name]) < 3.0
    intervals = [(m.interval_mm, true.measures[n].mm) for n, m in named.measures.items()]
    assert len(intervals) > 50
    assert np.mean([low <= value <= high for (low, high), value in intervals]) > 0.8


def test_every_definition_is_whole() -> None:
    definitions = read_definitions()
    names = [definition["name"] for definition in definitions]
    assert len(set(names)) == len(names) >= 40
    for definition in definitions:
        assert {"standard", "definition", "kind", "sigma_mm"} <= set(definition)
        assert set(definition["landmarks"]) <= set(TEMPLATE.landmarks)
        parts = definition.get("part", [])
        assert set([parts] if isinstance(parts, str) else parts) <= set(TEMPLATE.part_names)


def test_what_is_no_standing_body_is_refused() -> None:
    egg = ellipsoid((250.0, 150.0, 850.0), (0.0, 0.0, 850.0), resolution=60)
    with pytest.raises(BadInput, match="no standing body"):
        measure_by_name(mesh_of(*egg))


def test_a_web_between_arm_and_trunk_is_no_part_of_a_girth() -> None:
    body = register_exactly(*make_body(3))
    true = take_measures(body).measures
    armpit = body.fitted.vertices[TEMPLATE.landmarks["left axilla"]]
    trunk = np.isin(TEMPLATE.parts, [TEMPLATE.part_names.index("trunk")])
    reach = np.linalg.norm(body.fitted.vertices - armpit, axis=1)
    hidden = trunk & (reach < 110.0)
    web = body.mesh.vertices + np.where(hidden, 40.0, 0.0)[:, None] * body.mesh.normals
    webbed = replace(body, mesh=replace(body.mesh, vertices=web))
    found = take_measures(hide(webbed, hidden)).measures
    for name in ("bust girth", "chest breadth"):
        assert found[name].mm == pytest.approx(true[name].mm, abs=1.0), name
        low, high = found[name].interval_mm
        assert low < true[name].mm < high
    assert found["bust girth"].measured < 0.95


def test_a_part_that_is_not_there_has_no_landmarks() -> None:
    head, body = TEMPLATE.part_names.index("head"), register_exactly(*make_body(3))
    named = take_measures(hide(body, TEMPLATE.parts == head))
    assert "pronasale" not in named.landmarks
    assert named.missing["head length"] == "nothing was measured near its landmark glabella"
    forearm = TEMPLATE.parts == TEMPLATE.part_names.index("left forearm")
    forearm[::3] = False  # where the template lies on something else
    named = take_measures(hide(body, forearm))
    assert {"left olecranon", "left dactylion"}.isdisjoint(named.landmarks)
    assert named.missing.keys() > {"left arm length", "left forearm girth", "left wrist girth"}


def test_a_thigh_is_not_the_trunk_above_the_other_one() -> None:
    body = register_exactly(*make_body(4))
    crotch = body.fitted.vertices[TEMPLATE.landmarks["crotch"]][2]
    for below in (10.0, 25.0):
        left, right = (
            BodySections(body).cut(UP, crotch - below, [f"{side} thigh", "trunk"])
            for side in ("left", "right")
        )
        assert left is not None
        assert right is not None
        assert left.tape_mm == pytest.approx(right.tape_mm, rel=0.1)
    low, high = (
        take_measures(register_exactly(*make_body(7))).measures["left thigh girth"].interval_mm
    )
    assert high - low < 20.0  # at the fold of the buttock, with some of the other one, 140


def test_a_tape_from_the_base_of_the_neck_leaves_the_neck() -> None:
    body = register_exactly(*make_body(3))
    neck = TEMPLATE.parts == TEMPLATE.part_names.index("neck")
    wider = body.mesh.vertices + np.where(neck, 12.0, 0.0)[:, None] * body.mesh.normals
    found = take_measures(replace(body, mesh=replace(body.mesh, vertices=wider))).measures
    name = "left approximate neck to bust point"
    assert found[name].mm == pytest.approx(take_measures(body).measures[name].mm, abs=3.0)


def test_a_depth_is_measured_where_its_ends_are_and_a_girth_all_around() -> None:
    body = register_exactly(*make_body(3))
    true_mm = take_measures(body).measures["waist girth"].mm
    above = body.fitted.vertices[:, 2] - body.fitted.vertices[TEMPLATE.landmarks["left waist"]][2]
    for facing, is_range in ((0.99, False), (0.8, True)):
        flanks = (np.abs(body.mesh.normals[:, 1]) > facing) & (np.abs(above) < 100.0)
        # The template closes them 1.5 mm too far out.
        fitted = body.fitted.vertices + 1.5 * flanks[:, None] * body.mesh.normals
        closed = replace(body, fitted=replace(body.fitted, vertices=fitted))
        found = take_measures(hide(closed, flanks)).measures
        assert found["waist depth"].measured == 1.0
        assert found["waist breadth"].measured == 0.0
        waist = found["waist girth"]
        assert waist.measured < 0.9
        assert waist.is_range == is_range
        assert waist.interval_mm[0] < true_mm < waist.interval_mm[1]
    back = (body.mesh.normals[:, 0] < 0.0) & (np.abs(above) < 100.0)
    waist = (measures := take_measures(hide(body, back)).measures)["waist girth"]
    with pytest.raises(KeyError, match="did you mean 'waist girth'"):
        measures["waist"]
    assert waist.is_range
    low, high = waist.interval_mm
    assert low < true_mm - 20.0 < high


def test_a_measure_that_wants_other_arms_is_marked() -> None:
    for arms_deg, departs in ((25.0, True), (-15.0, False)):
        named = take_measures(register_exactly(*make_body(3, arms_deg=arms_deg)))
        assert ("arms down" in named.measures["bust girth"].stance) == departs
        assert "arms down" not in named.measures["left calf girth"].stance


def test_changes_that_are_certain_exceed_both_scans_errors() -> None:
    body = register_exactly(*make_body(3))
    earlier, above = take_measures(body), body.vertices[:, 2]
    waist = body.fitted.vertices[TEMPLATE.landmarks["left waist"]][2]
    trunk = body.parts == TEMPLATE.part_names.index("trunk")
    belly = 12.0 * np.exp(-(((above - waist) / 60.0) ** 2)) * trunk
    grown = body.mesh.vertices + belly[:, None] * body.mesh.normals
    later = take_measures(replace(body, mesh=replace(body.mesh, vertices=grown)))
    changes = {one.name: one for one in find_changes(earlier, later)}
    assert changes["waist girth"].mm == pytest.approx(75.0, abs=8.0)
    assert changes["waist girth"].is_certain
    assert not changes["left calf girth"].is_certain
