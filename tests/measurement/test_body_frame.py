"""A body's own frame, however it stands in the rig."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.measurements import rig_from_body


def standing() -> np.ndarray:
    """A body's frame: an upper body twice as wide as deep, and feet, which point forward."""
    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    height = np.linspace(800.0, 1700.0, 60)
    ring = np.stack([120.0 * np.cos(angle), 240.0 * np.sin(angle)], axis=-1)
    upper = np.concatenate([np.column_stack([ring, np.full(72, z)]) for z in height])
    x, y = np.meshgrid(np.linspace(-60.0, 900.0, 60), [-80.0, 80.0])
    feet = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 40.0)])
    return np.concatenate([upper, feet])


@pytest.mark.parametrize("degrees", [0.0, 25.0, -70.0, 85.0])
def test_a_body_faces_the_way_across_its_width_that_is_nearer_to_the_rigs(degrees: float) -> None:
    true = RigidTransform.from_rotation_vector([0.0, 0.0, np.radians(degrees)], [150.0, -60.0, 0.0])
    found = rig_from_body(true.apply(standing()))
    np.testing.assert_allclose(found.rotation, true.rotation, atol=1e-9)
    # The middle of the upper body; the outermost 2 % do not count, which are alike on all sides.
    np.testing.assert_allclose(found.translation, true.translation, atol=0.5)


def test_something_carried_on_one_side_of_few_points_moves_nothing() -> None:
    body = standing()
    carried = np.column_stack(
        [np.full(40, 0.0), np.linspace(600.0, 900.0, 40), np.full(40, 1200.0)]
    )
    found = rig_from_body(np.concatenate([body, carried]))
    assert np.abs(found.translation).max() < 6.0  # extremes would move it by 330


def test_one_who_faces_backwards_is_taken_to_face_the_rig() -> None:
    turned = RigidTransform.from_rotation_vector([0.0, 0.0, np.pi], np.zeros(3))
    found = rig_from_body(turned.apply(standing()))
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-9)
