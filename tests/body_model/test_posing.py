"""The template's body in shapes and poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_registered import make_body

from bodyscan.body_model.fitting import Surface, differentiate, fit_body
from bodyscan.body_model.template import BodyShapeAndPose, load_template, pose_body
from bodyscan.mesh.topology import compute_topology, compute_vertex_normals

TEMPLATE = load_template()
REST = BodyShapeAndPose(
    np.zeros(len(TEMPLATE.shapes)), np.zeros_like(TEMPLATE.joints), TEMPLATE.joints[0]
)


def test_the_mean_shape_in_the_rest_pose_is_the_template() -> None:
    assert np.allclose(pose_body(TEMPLATE, REST).vertices, TEMPLATE.vertices, atol=1e-9)


def test_the_template_is_a_closed_surface_with_both_sides_alike() -> None:
    topology = compute_topology(TEMPLATE.vertices, TEMPLATE.faces)
    assert topology.manifold
    assert topology.components == 1
    assert topology.volume_mm3 > 0.0
    for left, vertex in TEMPLATE.landmarks.items():
        if left.startswith("left "):
            right = TEMPLATE.landmarks[left.replace("left ", "right ")]
            mirrored = TEMPLATE.vertices[right] * [1.0, -1.0, 1.0]
            # The mean of a random population is alike on both sides to a millimetre or so.
            assert np.linalg.norm(TEMPLATE.vertices[vertex] - mirrored) < 4.0


def test_bending_an_elbow_moves_forearm_and_hand_alone() -> None:
    elbow = TEMPLATE.joint_names.index("left forearm")
    rotations = np.zeros_like(TEMPLATE.joints)
    rotations[elbow] = [0.0, -0.5, 0.0]
    posed = pose_body(TEMPLATE, replace(REST, rotations=rotations))
    moved = np.linalg.norm(posed.vertices - TEMPLATE.vertices, axis=1)
    hand = TEMPLATE.parts == TEMPLATE.part_names.index("left hand")
    leg = TEMPLATE.parts == TEMPLATE.part_names.index("left thigh")
    assert moved[hand].min() > 50.0
    assert moved[leg].max() < 1e-9


@pytest.mark.parametrize("column", [1, 3 + 3 * 6 + 2, 3 + 3 * 14, 3 + 3 * 19 + 1])
def test_derivatives_are_those_of_the_posed_body(column: int) -> None:
    rng = np.random.default_rng(5)
    body = BodyShapeAndPose(
        rng.normal(0.0, 1.0, len(TEMPLATE.shapes)),
        rng.normal(0.0, 0.2, TEMPLATE.joints.shape),
        np.array([10.0, -20.0, 900.0]),
    )
    some = np.arange(0, len(TEMPLATE.vertices), 97)
    posed = pose_body(TEMPLATE, body)
    normals = compute_vertex_normals(posed.vertices, TEMPLATE.faces)[some].astype(np.float64)
    derivative = differentiate(TEMPLATE, body, posed, some, normals)[:, column]
    step = np.zeros(3 + 3 * len(TEMPLATE.joints) + len(TEMPLATE.shapes))
    step[column] = 1e-4
    ends = [pose_body(TEMPLATE, body.add_step(sign * step)).vertices[some] for sign in (1.0, -1.0)]
    expected = np.einsum("vi,vi->v", ends[0] - ends[1], normals) / 2e-4
    # Central differences of float32 shapes: a hundredth of a millimetre per unit.
    assert derivative == pytest.approx(expected, abs=0.02 + 1e-4 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 7])
def test_fingers_are_not_laid_on_their_neighbours(seed: int) -> None:
    vertices, _, _ = make_body(seed)
    normals = compute_vertex_normals(vertices, TEMPLATE.faces).astype(np.float64)
    fitted = fit_body(TEMPLATE, Surface(vertices[::2], normals[::2]))
    for side in ("left", "right"):
        for name in ("dactylion", "radial styloid", "ulnar styloid"):
            vertex = TEMPLATE.landmarks[f"{side} {name}"]
            assert np.linalg.norm(fitted.vertices[vertex] - vertices[vertex]) < 8.0, name
