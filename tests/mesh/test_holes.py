"""Where a mesh was filled: how large each patch is, where, and which way it faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.arrays import Indices
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.holes import WAYS, holes


def box() -> tuple[np.ndarray, Indices]:
    """Of 200 x 100 x 400 mm, two faces a side: corner 4 i + 2 j + k."""
    corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    quads = {
        "back": (0, 1, 3, 2), "front": (4, 6, 7, 5), "right": (0, 4, 5, 1),
        "left": (2, 3, 7, 6), "down": (0, 2, 6, 4), "up": (1, 5, 7, 3),
    }  # fmt: skip
    faces = [[q[0], q[m], q[m + 1]] for q in (quads[way] for way in WAYS) for m in (1, 2)]
    return corner * [200.0, 100.0, 400.0], np.array(faces)


def mesh(*filled: str) -> BodyMesh:
    vertices, faces = box()
    ways = np.repeat(list(WAYS), 2)
    count = len(vertices)
    return BodyMesh(
        vertices=vertices,
        faces=faces,
        normals=np.zeros((count, 3), np.float32),
        sigma_mm=np.zeros(count, np.float32),
        colours=np.zeros((count, 3), np.uint8),
        filled=np.isin(ways, filled),
    )


SIDES = {
    "front": (40000.0, (200, 50, 200)), "back": (40000.0, (0, 50, 200)),
    "left": (80000.0, (100, 100, 200)), "right": (80000.0, (100, 0, 200)),
    "up": (20000.0, (100, 50, 400)), "down": (20000.0, (100, 50, 0)),
}  # fmt: skip


@pytest.mark.parametrize("way", list(WAYS))
def test_a_patch_has_its_area_its_middle_and_its_way(way: str) -> None:
    (hole,) = holes(mesh(way))
    assert hole.faces == way
    assert hole.area_mm2 == pytest.approx(SIDES[way][0])
    np.testing.assert_allclose(hole.middle, SIDES[way][1])


def test_the_largest_comes_first_and_patches_that_touch_are_one() -> None:
    for scale, order in ((0.5, ["down", "up"]), (2.0, ["up", "down"])):
        tapered = mesh("up", "down")
        tapered.vertices[tapered.vertices[:, 2] > 0.0, :2] *= scale
        assert [one.faces for one in holes(tapered)] == order
    (one,) = holes(mesh("up", "left"))
    assert one.area_mm2 == pytest.approx(100000.0)
    assert one.faces == "left"
    np.testing.assert_allclose(one.middle, [100.0, 90.0, 240.0])  # by area
    assert holes(mesh()) == []


@pytest.mark.parametrize("way", list(WAYS))
def test_a_patch_that_leans_by_40_degrees_still_faces_its_way(way: str) -> None:
    whole = mesh(way)
    normal = np.array(WAYS[way])
    for other in np.eye(3):
        if normal @ other:
            continue
        for side in (1.0, -1.0):
            # Sheared so that the face's normal leans towards another side.
            lean = np.eye(3) - np.tan(np.radians(40.0)) * side * np.outer(normal, other)
            (hole,) = holes(replace(whole, vertices=whole.vertices @ lean.T))
            assert hole.faces == way
