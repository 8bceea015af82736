"""What another program knows of a pair: told where it cannot be so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.calibration.known_pair import (
    _convert_projector,
    _require_baseline,
    compute_parameter_sigmas,
)
from bodyscan.calibration.model_selection import HeldOutModel
from bodyscan.calibration.pair import PairQuality
from bodyscan.errors import CalibrationFileError
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform

SIZE = (1280, 800)


def projector(size: tuple[int, int] | None, *ways: Any) -> Any:
    matrix = np.array([[1500.0, 0.0, 630.2], [0.0, 1500.0, 410.4], [0.0, 0.0, 1.0]])
    found: Any = SimpleNamespace(
        size=size, where="theirs.json", matrix=matrix, projector=lambda *size: size
    )
    code: Any = SimpleNamespace(directions=ways)
    return _convert_projector(found, code)


def stripes(
    direction: str, count: int, *, edges: bool = True, origin: float | None = None
) -> SimpleNamespace:
    return SimpleNamespace(direction=direction, stripes=count, has_edges=edges, origin=origin)


def test_stripes_divide_the_picture_evenly() -> None:
    assert projector(SIZE, stripes("vertical", 1280), stripes("horizontal", 400)) == SIZE
    assert projector(SIZE, stripes("vertical", 300, edges=False)) == SIZE
    assert projector(SIZE, stripes("vertical", 1280, origin=3.0)) == SIZE
    for way, said in (
        (stripes("vertical", 300), r"1280 x 800 px, which 300 vertical .* evenly \(4.267 px each"),
        (stripes("horizontal", 300), r"which 300 horizontal stripes .* evenly \(2.667 px each"),
        (stripes("vertical", 1281), "1280 x 800 px, which 1281 vertical stripes do not divide"),
        (
            stripes("vertical", 640, origin=2.5),
            "1280 x 800 px, but its waves begin at `origin: 2.5` of",
        ),
    ):
        with pytest.raises(CalibrationFileError, match=said):
            projector(SIZE, way)


def test_without_a_size_a_stripe_is_a_pixel_and_the_axis_in_the_middle() -> None:
    assert projector(None, stripes("vertical", 1024)) == (1024, 821)
    assert projector(None, stripes("horizontal", 768)) == (1260, 768)


@pytest.mark.parametrize("baseline_mm", [0.4, 50_000.0])
def test_a_projector_stands_millimetres_to_metres_from_its_camera(baseline_mm: float) -> None:
    place = RigidTransform.from_translation([baseline_mm, 0.0, 0.0])
    known: Any = SimpleNamespace(units="m")
    with pytest.raises(CalibrationFileError, match="mm from its camera"):
        _require_baseline(place, "theirs.json", known)


def test_each_parameter_by_itself_moves_no_pixel_by_more_than_sigma() -> None:
    camera = Camera(900.0, 910.0, 0.0, 320.0, 240.0, Radial(-0.1, 0.05), 640, 480)
    sigmas = compute_parameter_sigmas(camera, 0.5)
    u, v = np.meshgrid(np.linspace(0.0, 639.0, 41), np.linspace(0.0, 479.0, 41))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels)
    for k, sigma in enumerate(sigmas):
        moved = camera.retract(1e-3 * sigma * np.eye(len(sigmas))[k])
        shift = 1e3 * np.linalg.norm(moved.project(rays) - pixels, axis=1)
        assert shift.max() == pytest.approx(0.5, rel=0.01)


def test_light_that_another_program_calibrated_is_called_so_and_other_light_by_its_model() -> None:
    tried = tuple(
        HeldOutModel(name, 0.1, 0.1, 0.1, 1.0, name == "lens") for name in ("planes", "lens")
    )
    assert PairQuality(0.1, 5, held_out=tried).light_model == "lens"
    assert PairQuality(0.1, 5, held_out=tried[:1]).light_model is None
    assert (
        PairQuality(None, 0, imported="theirs.json", stripes_projected=63).light_model == "imported"
    )
    # A camera alone, without light of its own.
    camera = PairQuality(None, 0, imported="theirs.json")
    assert camera.light_model is None
    # Nothing is known of the accuracy of what was imported without a sigma.
    assert camera.unjudged
    assert not PairQuality(None, 0, imported="theirs.json", imported_sigma_px=0.0).unjudged
    assert not PairQuality(0.1, 5).unjudged
