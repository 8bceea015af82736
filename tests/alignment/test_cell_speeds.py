"""Speeds that stripes tell, gathered by cells of the body, with what they all may be off by."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from bodyscan.alignment.body_cells import CELL_MM
from bodyscan.alignment.cell_speeds import CellSpeeds
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.velocity import SurfaceSpeeds

PLACE = RigidTransform.from_rotation_vector([0.3, -0.8, 0.2], [400.0, -100.0, 900.0])
CENTRES = np.array([[0.0, 0.0, 900.0], [0.0, 200.0, 1000.0], [0.0, -200.0, 1100.0]])


class Cells:
    """Three cells, far from each other."""

    centres = CENTRES

    def find(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        return np.argmin(np.linalg.norm(points[:, None] - CENTRES, axis=2), axis=1)


def told(shared: int = 2, far: bool = True) -> SurfaceSpeeds:
    """Of 40 places near the first two cells, and one between them all."""
    rng = np.random.default_rng(0)
    count = 40
    points = CENTRES[np.arange(count) % 2] + rng.uniform(-0.3, 0.3, (count, 3)) * CELL_MM
    if far:
        points[7] = CENTRES[1] + [1.01 * CELL_MM, 0.0, 0.0]
    facing = rng.normal(size=(count, 3))
    return SurfaceSpeeds(
        PLACE.inverse().apply(points),
        PLACE.inverse().rotate(facing),
        rng.normal(size=count),
        rng.uniform(0.5, 2.0, count),
        rng.normal(size=(count, shared)),
    )


def gathered(seen: SurfaceSpeeds) -> CellSpeeds:
    return CellSpeeds.of(seen, PLACE, cast(Any, Cells()))


def test_each_place_counts_in_its_cell_by_its_variance_and_far_ones_do_not() -> None:
    seen = told()
    found = gathered(seen)
    assert found.cells.tolist() == [0, 1]
    assert gathered(told(far=False)).information[1, 0, 0] != found.information[1, 0, 0]
    kept = np.arange(40) != 7
    facing = PLACE.rotate(seen.facing)
    for cell in (0, 1):
        own = kept & (np.arange(40) % 2 == cell)
        weight = seen.sigma[own] ** -2.0
        np.testing.assert_allclose(
            found.information[cell], (facing[own].T * weight) @ facing[own], rtol=1e-9
        )
        # Cells are carried back: against the body's own speed.
        np.testing.assert_allclose(
            found.gradient[cell], -(facing[own].T * weight) @ seen.speed[own], rtol=1e-9
        )


def test_what_is_asked_of_fields_leaves_open_what_all_are_off_by() -> None:
    seen = told()
    kept = np.arange(40) != 7
    fields = np.random.default_rng(1).normal(size=(3, 12, 4))
    # By one system of fields and shared errors together, these of standard deviation 1.
    carried = np.einsum("nk,nkm->nm", PLACE.rotate(seen.facing), fields[np.arange(40) % 2, :3])[
        kept
    ]
    rows = np.hstack([carried, seen.shared[kept]]) / seen.sigma[kept, None]
    whole = rows.T @ rows + np.diag([0.0] * 4 + [1.0] * 2)
    right = rows.T @ (-seen.speed[kept] / seen.sigma[kept])
    reduced = whole[:4, :4] - whole[:4, 4:] @ np.linalg.solve(whole[4:, 4:], whole[4:, :4])
    normal, pull = gathered(seen).asked(fields)
    np.testing.assert_allclose(normal, reduced, rtol=1e-8)
    wanted = right[:4] - whole[:4, 4:] @ np.linalg.solve(whole[4:, 4:], right[4:])
    np.testing.assert_allclose(pull, wanted, rtol=1e-8)
