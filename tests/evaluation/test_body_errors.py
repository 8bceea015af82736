"""The measures themselves, on bodies that are off by a known amount."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from made_bodies import mesh_of

from bodyscan.evaluation.body import (
    compute_girth_errors,
    compute_sway_residual,
    measure_true_girths,
    measure_visible_coverage,
)
from bodyscan.geometry.camera import Camera, describe_camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BreathAt

CAMERA = Camera(300.0, 300.0, 0.0, 160.0, 128.0, Radial(), 320, 256)


def column(radius: float, height: float = 1700.0) -> tuple[np.ndarray, np.ndarray]:
    made = o3d.geometry.TriangleMesh.create_cylinder(radius, height, resolution=90, split=80)
    vertices = np.asarray(made.vertices) + [0.0, 0.0, height / 2]
    return vertices, np.asarray(made.triangles).astype(np.int64)


def test_a_body_half_a_millimetre_too_thick() -> None:
    vertices, faces = column(150.0)
    found = compute_girth_errors(
        mesh_of(*column(150.5, 1701.0)), measure_true_girths(vertices, faces)
    )
    assert found.heights > 25
    assert found.rms_mm == pytest.approx(2 * np.pi * 0.5, rel=1e-2)
    assert found.worst_mm == pytest.approx(found.rms_mm, rel=1e-3)
    assert found.stature_mm == pytest.approx(1.0)


def test_breath_stays_in_unless_the_truth_is_at_mean_breath() -> None:
    vertices, faces = column(150.0)
    body = mesh_of(vertices, faces)
    inside = np.full(len(vertices), 0.5, np.float32)
    breathing = replace(body, breath=BreathAt(inside, np.full_like(inside, 0.1)))
    assert compute_girth_errors(breathing, measure_true_girths(vertices, faces)).rms_mm < 0.01
    at_mean = compute_girth_errors(
        breathing, measure_true_girths(vertices, faces), mean_breath=True
    )
    assert at_mean.rms_mm == pytest.approx(2 * np.pi * 0.5, rel=2e-2)


def test_what_was_filled_is_not_judged() -> None:
    vertices, faces = column(150.0)
    thick, _ = column(160.0)
    body = mesh_of(thick, faces, np.ones(len(faces), bool))
    assert compute_girth_errors(body, measure_true_girths(vertices, faces)).heights == 0


def pairs(sways: list[RigidTransform]) -> dict[str, dict[str, Any]]:
    """Cameras in front of the column, each with its projector 300 mm above it."""
    turn = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = RigidTransform(turn, np.array([1500.0, 0.0, 850.0]))
    return {
        f"p{k}": {
            "camera": describe_camera(CAMERA),
            "rig_from_camera": camera.matrix,
            "projector": {"centre": [0.0, -300.0, 0.0]},
            "swayed_from_still": sway.matrix,
        }
        for k, sway in enumerate(sways)
    }


def test_sway_left_in_is_told_and_a_common_motion_is_not() -> None:
    vertices, _ = column(150.0)
    common = RigidTransform.from_rotation_vector([0.0, 0.0, 0.01], [5.0, -2.0, 0.0])
    aside = RigidTransform(np.eye(3), np.array([0.0, 0.6, 0.0]))
    true = pairs([RigidTransform.identity(), RigidTransform.identity()])
    cameras = {name: RigidTransform.from_matrix(p["rig_from_camera"]) for name, p in true.items()}
    rig_from_still, left = compute_sway_residual(
        {name: common @ t for name, t in cameras.items()}, true, vertices
    )
    assert left < 1e-9
    np.testing.assert_allclose(rig_from_still.matrix, common.matrix, atol=1e-6)
    _, left = compute_sway_residual(
        {"p0": cameras["p0"], "p1": aside @ cameras["p1"]}, true, vertices
    )
    assert left == pytest.approx(0.3)


@pytest.mark.slow
def test_only_what_camera_and_projector_see_counts() -> None:
    vertices, faces = column(150.0)
    seen, covered = measure_visible_coverage(
        vertices, vertices, faces, pairs([RigidTransform.identity()])
    )
    # Less than the half that faces the camera; of 0.85 m x 1.1 m at 1.35 m.
    assert 0.15 < seen < 0.45
    assert covered < 0.2  # the column's own vertices lie 10 mm and more apart
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(-np.pi, np.pi, 1_000_000), rng.uniform(0.0, 1700.0, 1_000_000)
    dense = np.stack([150.0 * np.cos(angle), 150.0 * np.sin(angle), height], axis=-1)
    true = pairs([RigidTransform.identity()])
    assert measure_visible_coverage(dense, vertices, faces, true)[1] > 0.98
    off = dense + [1.5, 0.0, 0.0]
    assert measure_visible_coverage(off, vertices, faces, true)[1] < 0.6


def test_no_camera_sees_beyond_the_middles_of_its_last_pixels() -> None:
    """200 mm a pixel: 4 x 3 of them of a wall of 2 x 2 m, 1 m away."""
    wall = 1000.0 * np.array([[-1.0, -1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, 1]])
    faces = np.array([[0, 2, 1], [1, 2, 3]])
    coarse = Camera(5.0, 5.0, 0.0, 2.0, 1.5, Radial(), 5, 4)
    still = RigidTransform.identity().matrix
    facts = {
        "rig_from_camera": still,
        "swayed_from_still": still,
        "camera": describe_camera(coarse),
        "projector": {"centre": [0.0, 0.0, 0.0]},
    }
    seen, _ = measure_visible_coverage(wall, wall, faces, {"p": facts})
    # Spots are drawn at random: a standard deviation of 0.3 % of some 20,000.
    assert seen == pytest.approx(800.0 * 600.0 / 2000.0**2, rel=0.05)
