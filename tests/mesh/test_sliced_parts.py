"""Parts of bodies whose arms hang free or touch, of any size, and which way they face."""

from __future__ import annotations

import numpy as np
import pytest
from made_bodies import together
from standing_body import HAND_ON_HIP, Rod, hanging, standing_body, trunk_tape

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body_frame import find_body_frame
from bodyscan.mesh.sliced_parts import BodyParts, find_parts
from bodyscan.mesh.slices import MeshSlicer

FREE = {"trunk", "left arm", "right arm"}


def parts_of(
    arms: list[Rod], heights: tuple[float, ...], *, scale: float = 1.0, **given: float
) -> BodyParts:
    body = standing_body(arms, scale=scale, **given)
    return find_parts(MeshSlicer(*body), [scale * height for height in heights])


def tapes(parts: BodyParts, height: float) -> dict[str, float]:
    return {piece.part: piece.loop.tape_mm for piece in parts.slices[height]}


@pytest.mark.parametrize("scale", [1.0, 0.6])
@pytest.mark.parametrize("stout", [0.85, 1.0, 1.25])
def test_free_arms_and_legs_are_told_apart_at_any_size(scale: float, stout: float) -> None:
    parts = parts_of(hanging(25.0), (400.0, 760.0, 1000.0, 1600.0), scale=scale, stout=stout)
    assert {piece.part for piece in parts.slices[400.0 * scale]} == {"left leg", "right leg"}
    assert {"left leg", "right leg"} <= set(tapes(parts, 760.0 * scale))
    at_waist = tapes(parts, 1000.0 * scale)
    assert set(at_waist) == FREE
    assert at_waist["trunk"] == pytest.approx(trunk_tape(scale, stout), rel=3e-3)
    assert set(tapes(parts, 1600.0 * scale)) == {"head"}
    assert at_waist["left arm"] == pytest.approx(at_waist["right arm"], rel=0.02)
    assert not [c for c in parts.contacts if "leg" not in c.parts[0] and c.low_mm < 1150.0 * scale]


def test_a_trunk_is_cut_from_arms_that_hang_against_it() -> None:
    """From the armpit down; what hangs beside thighs is an arm's still."""
    parts = parts_of(hanging(0.0), (900.0, 1000.0, 1100.0))
    for height in (900.0, 1000.0, 1100.0):
        found = tapes(parts, height)
        assert set(found) == FREE
        # The cell is 7 mm; with the arms it has 1,050 mm.
        assert found["trunk"] == pytest.approx(trunk_tape(), abs=14.0)
        trunk = next(piece for piece in parts.slices[height] if piece.part == "trunk")
        assert set(trunk.touches) == {"left arm", "right arm"}
    lengths = {c.parts[0]: c.high_mm - c.low_mm for c in parts.contacts if "trunk" in c.parts}
    assert min(lengths["left arm"], lengths["right arm"]) > 200.0


def test_of_arms_pressed_into_the_trunk_nothing_else_is_said() -> None:
    """No neck is left where they are deepest: the girth is that of all."""
    parts = parts_of(hanging(-3.0), (1000.0, 1100.0))
    assert all(set(tapes(parts, h)) == {"trunk and left arm and right arm"} for h in (1e3, 1.1e3))


def test_a_hand_on_the_hip_is_no_part_of_the_trunk() -> None:
    parts = parts_of(HAND_ON_HIP, (850.0, 930.0, 1050.0))
    assert tapes(parts, 1050.0)["trunk"] == pytest.approx(trunk_tape(), rel=3e-3)
    assert tapes(parts, 930.0)["trunk"] == pytest.approx(trunk_tape(), rel=0.02)
    hips = [c for c in parts.contacts if c.parts == ("left arm", "trunk") and c.high_mm < 1100.0]
    assert len(hips) == 1
    assert 850.0 < hips[0].low_mm < hips[0].high_mm < 1000.0


def test_thighs_that_touch_are_two_legs() -> None:
    parts = parts_of(hanging(25.0), (600.0,), apart_mm=66.0)
    found = {piece.part: piece for piece in parts.slices[600.0]}
    assert set(found) == {"left leg", "right leg"}
    assert found["left leg"].touches == ("right leg",)
    assert found["left leg"].loop.tape_mm == pytest.approx(2.0 * np.pi * 70.0, rel=0.02)


def test_a_leg_that_is_thin_below_the_crotch_is_no_other_body() -> None:
    vertices, faces = standing_body(hanging(25.0))
    thin = (
        (vertices[:, 1] > 0.0) & (vertices[:, 1] < 200.0) & (np.abs(vertices[:, 2] - 760.0) < 80.0)
    )
    vertices[thin, :2] += 0.45 * (vertices[thin, :2].mean(axis=0) - vertices[thin, :2])
    parts = find_parts(MeshSlicer(vertices, faces))
    assert not any(p.part == "other" for pieces in parts.slices.values() for p in pieces)


def test_what_stands_beside_a_person_is_none_of_its_parts() -> None:
    body = standing_body(hanging(25.0))
    two = together(body, (body[0] + [0.0, 1300.0, 0.0], body[1]))
    parts = find_parts(MeshSlicer(*two), [1000.0])
    assert sum(piece.part == "trunk" for piece in parts.slices[1000.0]) == 1
    assert "other" in {piece.part for piece in parts.slices[1000.0]}


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, -60.0])
@pytest.mark.parametrize("raised_mm", [0.0, 45.0, 150.0])
def test_a_body_faces_where_its_feet_point(degrees: float, raised_mm: float) -> None:
    turn = RigidTransform.from_rotation_vector([0.0, 0.0, np.radians(degrees)], [300.0, -90.0, 0.0])
    vertices = standing_body(hanging(25.0))[0]
    vertices[(vertices[:, 1] > 0.0) & (vertices[:, 2] < 500.0), 2] += raised_mm
    found = find_body_frame(turn.apply(vertices))
    assert found.known
    np.testing.assert_allclose(found.rig_from_body.rotation, turn.rotation, atol=0.02)


def test_without_feet_a_body_is_assumed_to_face_the_rigs_x() -> None:
    vertices = standing_body(hanging(25.0))[0]
    back = np.diag([-1.0, -1.0, 1.0])
    for turn in (np.eye(3), back):
        found = find_body_frame(vertices[vertices[:, 2] > 200.0] @ turn)
        assert not found.known
        np.testing.assert_allclose(found.rig_from_body.rotation, np.eye(3), atol=0.02)
