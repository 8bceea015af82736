"""Measures by name: a body of known landmarks, with surface that the template's shapes cannot make."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_bodies import ellipsoid, mesh_of

from bodyscan.arrays import Array
from bodyscan.body_model.fitting import FittedBody
from bodyscan.body_model.template import BodyShapeAndPose, PosedBody, load_template, pose_body
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.named import (
    NamedMeasures,
    measure_by_name,
    read_definitions,
    take_measures,
)
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.topology import vertex_normals

TEMPLATE = load_template()


def random_body(seed: int, *, arms_deg: float = 0.0) -> Array:
    """Vertices (V, 3) of a body in a scanning pose; 3 mm RMS of it are no shape of the template's."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(0.0, np.radians(3.0), TEMPLATE.joints.shape)
    lower = [name.endswith(("pelvis", "thigh", "shank", "foot")) for name in TEMPLATE.joint_names]
    rotations[lower] = 0.0  # both feet stand on the floor
    for side, sign in (("left", -1.0), ("right", 1.0)):
        arm = TEMPLATE.joint_names.index(f"{side} upper arm")
        rotations[arm, 0] += sign * np.radians(15.0 - arms_deg)
    shape = rng.normal(0.0, 0.8, len(TEMPLATE.shapes))
    vertices = pose_body(TEMPLATE, BodyShapeAndPose(shape, rotations, np.zeros(3))).vertices
    centres = vertices[rng.integers(0, len(vertices), 80)]
    near = np.exp(-((vertices[:, None] - centres) ** 2).sum(axis=2) / (2.0 * 60.0**2))
    bumps = near @ rng.normal(size=80)
    vertices += (3.0 * bumps / bumps.std())[:, None] * vertex_normals(vertices, TEMPLATE.faces)
    return vertices - np.append(vertices[:, :2].mean(axis=0), vertices[:, 2].min())


def scanned(vertices: Array, turn_deg: float = 0.0) -> BodyMesh:
    """The mesh of a scan: armpits, crotch and soles were not seen, and it may face anywhere."""
    hidden = np.zeros(len(vertices), bool)
    for name in ("left axilla", "right axilla", "crotch"):
        at = vertices[TEMPLATE.landmarks[name]]
        hidden |= np.linalg.norm(vertices - at, axis=1) < 35.0
    hidden |= vertices[:, 2] < 4.0
    hidden |= TEMPLATE.hidden
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turned = vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    filled = np.asarray(hidden[TEMPLATE.faces].any(axis=1))
    mesh = mesh_of(turned, TEMPLATE.faces, filled)
    return replace(mesh, sigma_mm=np.where(hidden, np.nan, np.float32(0.2)).astype(np.float32))


@cache
def example(seed: int) -> tuple[Array, NamedMeasures]:
    vertices = random_body(seed)
    return vertices, measure_by_name(scanned(vertices))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_landmarks_are_found_on_bodies_that_the_shapes_cannot_make(seed: int) -> None:
    vertices, named = example(seed)
    error = [
        np.linalg.norm(landmark.position_mm - vertices[TEMPLATE.landmarks[name]])
        for name, landmark in named.landmarks.items()
    ]
    # The project's aim; an expert's hand finds landmarks again to some 5 mm.
    assert np.median(error) < 5.0
    assert np.quantile(error, 0.9) < 15.0


def measure_truly(vertices: Array) -> NamedMeasures:
    """The same definitions on the true surface, at true landmarks."""
    mesh = mesh_of(vertices, TEMPLATE.faces)
    rest = BodyShapeAndPose(np.zeros(0), np.zeros((0, 3)), np.zeros(3))
    posed = PosedBody(vertices, np.zeros((0, 3, 3)), np.zeros((0, 3)))
    true = FittedBody(TEMPLATE, vertices, rest, posed, np.zeros(len(vertices)), 0.0)
    return take_measures(mesh, RigidTransform.identity(), true)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_intervals_hold_what_true_landmarks_give(seed: int) -> None:
    vertices, named = example(seed)
    true = measure_truly(vertices).measures
    held = [
        measure.interval_mm[0] <= true[name].mm <= measure.interval_mm[1]
        for name, measure in named.measures.items()
    ]
    assert len(held) > 50
    # 95 % intervals on some 59 measures that share landmarks.
    assert np.mean(held) > 0.8
    off = [abs(m.mm - true[name].mm) for name, m in named.measures.items() if "girth" in name]
    assert np.mean(off) < 3.0


@pytest.mark.slow
def test_it_may_face_anywhere() -> None:
    vertices, named = example(1)
    turned = measure_by_name(scanned(vertices, turn_deg=140.0))
    for name, one in named.measures.items():
        assert turned.measures[name].mm == pytest.approx(one.mm, abs=3.0), name


def test_every_definition_is_whole() -> None:
    definitions = read_definitions()
    names = [definition["name"] for definition in definitions]
    assert len(set(names)) == len(names) >= 40
    for definition in definitions:
        assert {"standard", "definition", "kind"} <= set(definition)
        assert set(definition["landmarks"]) <= set(TEMPLATE.landmarks)
        parts = definition.get("part", [])
        assert set([parts] if isinstance(parts, str) else parts) <= set(TEMPLATE.part_names)


def test_what_is_no_standing_body_is_refused() -> None:
    egg = mesh_of(*ellipsoid((250.0, 150.0, 850.0), (0.0, 0.0, 850.0), resolution=60))
    with pytest.raises(BadInput, match="no standing body"):
        measure_by_name(egg)
