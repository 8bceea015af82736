"""Hair in measurements: what stands on the head, and what girths run over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_bodies import cylinder, mesh_of
from ray_cast_scan import ROOT, load_body

from bodyscan.measurement.measurements import measure
from bodyscan.mesh.body import DARK_CLOTH, HAIR, SKIN, UNSURE, BodyMesh
from bodyscan.report.measurement_table import tables

HAIRLINE, SLANT = 0.95, 0.5
"""In statures, over the body's middle; rising towards the face."""


@pytest.fixture(scope="module", params=["woman", "man"])
def bald(request: pytest.FixtureRequest) -> BodyMesh:
    body = load_body(ROOT / "data" / "subjects" / f"{request.param}_average.ply", 1)
    mesh = mesh_of(body.vertices, body.faces)
    return replace(mesh, regions=np.full(len(mesh.vertices), SKIN, np.uint8))


def haired(bald: BodyMesh, thick_mm: float, line: float = HAIRLINE) -> BodyMesh:
    """With hair so thick above the line."""
    top = bald.vertices[:, 2].max()
    hair = bald.vertices[:, 2] > line * top + SLANT * bald.vertices[:, 0]
    grown = bald.vertices + thick_mm * hair[:, None] * bald.normals
    return replace(bald, vertices=grown, regions=np.where(hair, HAIR, SKIN).astype(np.uint8))


def told(mesh: BodyMesh) -> str:
    return "".join(
        str(cell) for table in tables(measure(mesh)) for c in table.columns for cell in c.cells
    )


def test_a_bare_head_is_as_high_as_the_body(bald: BodyMesh) -> None:
    found = measure(bald, [1000.0])
    assert found.crown == "skin"
    assert found.head is not None
    assert found.head.height_mm == found.stature_mm
    assert found.head.sigma_mm == pytest.approx(0.1)  # that of the vertices


@pytest.mark.parametrize("thick_mm", [3.0, 12.0, 25.0])
def test_under_hair_the_head_is_where_its_sigma_says(bald: BodyMesh, thick_mm: float) -> None:
    true = bald.vertices[:, 2].max()
    found = measure(haired(bald, thick_mm), [1000.0])
    assert found.stature_mm == pytest.approx(true + thick_mm, abs=0.5)
    assert found.crown == "hair"
    assert found.head is not None
    assert abs(found.head.height_mm - true) < 2.0 * found.head.sigma_mm
    # Hair of 3 mm leaves open no more than a few; that of 25 covers most of a forehead.
    assert found.head.sigma_mm < (20.0 if thick_mm > 12.0 else 8.0)
    assert found.head.height_mm < found.stature_mm


def test_where_no_forehead_shows_the_head_is_somewhere_truncate(bald: BodyMesh) -> None:
    body = haired(bald, 30.0, line=0.91)
    found = measure(body, [1000.0])
    assert found.head is not None
    low = body.vertices[body.regions == SKIN, 2].max()
    assert found.head.height_mm == pytest.approx(0.5 * (low + found.stature_mm), abs=1.0)
    assert found.head.sigma_mm == pytest.approx((found.stature_mm - low) / np.sqrt(12.0), abs=1.0)


def test_the_table_says_what_stature_is_of(bald: BodyMesh) -> None:
    shown = told(haired(bald, 12.0))
    assert "top of the hair" in shown
    assert "(estimate)" in shown
    assert "hair" not in told(bald)


def test_girths_that_run_over_hair_say_so() -> None:
    vertices, faces = cylinder(100.0, 0.0, 400.0)
    body = mesh_of(vertices, faces)
    regions = np.where(vertices[:, 1] > 0.0, HAIR, SKIN).astype(np.uint8)
    over = measure(replace(body, regions=regions), [150.0]).slices[0].girths[0]
    assert over.measured == 1.0
    assert over.regions is not None
    # Half of the outline, but for a face of 400 round at either end.
    assert over.regions["hair"] == pytest.approx(0.5, abs=0.01)
    assert over.measured_skin == pytest.approx(0.5, abs=0.01)
    cloth = replace(body, regions=np.full(len(vertices), DARK_CLOTH, np.uint8))
    assert "dark cloth 100 %" in told(cloth)
    bare = measure(body, [150.0]).slices[0].girths[0]
    assert (bare.regions, bare.measured_skin) == (None, 1.0)


def test_what_was_filled_is_of_no_region() -> None:
    vertices, faces = cylinder(100.0, 0.0, 400.0)
    body = mesh_of(vertices, faces, np.ones(len(faces), bool))
    found = measure(replace(body, regions=np.full(len(vertices), SKIN, np.uint8)), [150.0])
    assert found.regions is not None
    assert found.regions["unsure"] == 1.0
    assert UNSURE == 0
