"""The projectors against light followed step by step: from the laser, off the mirror, outward."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.simulation.layout import build_mirror, build_pinhole
from bodyscan.simulation.projector import MirrorProjector, PinholeProjector
from bodyscan.simulation.settings import Projection

ABOVE = RigidTransform.from_rotation_vector([-0.2, 0.03, 0.02], [15.0, -280.0, 10.0])
SEEN = (
    np.stack(
        np.meshgrid(np.linspace(-0.42, 0.42, 7), np.linspace(-0.34, 0.34, 7), [1.0]), axis=-1
    ).reshape(-1, 3)
    * np.array([800.0, 1300.0, 1800.0])[:, None, None]
)
SEEN = SEEN.reshape(-1, 3)


def mirror(horizontal: bool = True, **change: Any) -> MirrorProjector:
    projection = replace(Projection(), **change)
    rng = np.random.default_rng(5)
    return build_mirror(ABOVE, 640, horizontal, SEEN, projection, rng)


def followed_light(projector: MirrorProjector, s: float, spread: float) -> np.ndarray:
    """(2, 3): where a ray of the laser's fan meets the mirror, and a place further on its way."""
    angle = projector.first_angle + s / projector.stripes * projector.sweep_angle
    turned = RigidTransform.from_rotation_vector(projector.axis * angle, np.zeros(3))
    normal = turned.rotation @ projector.zero
    edge = np.cross(projector.sheet, projector.aim)
    ray = projector.aim + spread * edge
    surface = projector.centre + projector.offset_mm * normal
    hit = projector.laser + ray * (normal @ (surface - projector.laser)) / (normal @ ray)
    return np.stack([hit, hit + 1000.0 * (ray - 2 * (ray @ normal) * normal)])


@settings(max_examples=40, deadline=None)
@given(s=st.floats(0, 640), spread=st.floats(-0.3, 0.3), horizontal=st.booleans())
def test_light_followed_off_the_mirror_carries_its_stripe(
    s: float, spread: float, horizontal: bool
) -> None:
    projector = mirror(horizontal)
    start, place = followed_light(projector, s, spread)
    assert projector.stripe(place) == pytest.approx(s, abs=1e-9)
    # single precision: angles of 1e-7 rad, stripes of 7e-4 rad of mirror
    assert projector.stripe(place.astype(np.float32)) == pytest.approx(s, abs=1e-3)
    back = start - place
    source = projector.source(np.array(s))
    # the light seems to come straight from the mirrored laser, behind the mirror
    assert np.cross(back / np.linalg.norm(back), source - start) == pytest.approx(0, abs=1e-9)
    assert back @ (source - start) > 0
    plane = projector.plane(np.array(s))
    assert plane[:3] @ place + plane[3] == pytest.approx(0, abs=1e-8)


def line_in_common(planes: np.ndarray) -> float:
    """How far planes (N, 4), lengths in m, are from sharing one line: 0 if they do."""
    return float(np.linalg.svd(planes / np.linalg.norm(planes, axis=1, keepdims=True))[1][2])


def metres(planes: np.ndarray) -> np.ndarray:
    return planes * [1, 1, 1, 1e-3]


def test_sheets_share_no_line() -> None:
    s = np.linspace(0, 640, 65)
    real = line_in_common(metres(mirror().plane(s)))
    true: dict[str, Any] = {"mirror_offset_mm": (0.0, 0.0), "sheet_tilt_deg": 0.0, "aim_mm": 0.0}
    ideal = line_in_common(metres(mirror(**true).plane(s)))
    assert ideal < 1e-12  # a mirror and a sheet through the axis: all planes hold the axis
    assert real > 1e-3  # about a millimetre and more, at a metre
    for one in ("mirror_offset_mm", "sheet_tilt_deg"):
        part = mirror(**{key: value for key, value in true.items() if key != one})
        assert line_in_common(metres(part.plane(s))) > 1e-4


@pytest.mark.parametrize("build", [build_mirror, build_pinhole])
@pytest.mark.parametrize("horizontal", [True, False])
def test_sweep_covers_what_the_camera_sees(
    build: Callable[..., MirrorProjector | PinholeProjector], horizontal: bool
) -> None:
    projector = build(ABOVE, 640, horizontal, SEEN, Projection(), np.random.default_rng(2))
    s = projector.stripe(SEEN)
    assert np.isfinite(s).all()
    assert s.min() == pytest.approx(640 * 0.02 / 1.04, abs=1e-6)  # the margin, and no more
    assert s.max() == pytest.approx(640 - 640 * 0.02 / 1.04, abs=1e-6)
    image = SEEN[:, 1 if horizontal else 0] / SEEN[:, 2]
    assert np.corrcoef(image, s)[0, 1] > 0.8  # stripes are counted down, or to the right


def test_smile_bows_the_ends_only() -> None:
    straight, bowed = mirror(), mirror(smile_stripes=0.5)
    across = np.abs(straight.fan_tangent(SEEN, straight.angle(SEEN))) / straight.fan
    assert bowed.stripe(SEEN) - straight.stripe(SEEN) == pytest.approx(0.5 * across**2)


def flatness(projector: PinholeProjector) -> float:
    """Largest distance (mm) of a stripe's light from its best plane, at 0.8 to 1.6 m."""
    x = np.linspace(-250, 250, 41)
    y = np.linspace(-330, 330, 3001)
    lines = []
    for z in (800.0, 1200.0, 1600.0):
        grid = np.stack(np.meshgrid(x, y, [z], indexing="ij"), axis=-1)[:, :, 0]
        s = projector.stripe(grid)
        height = [np.interp(150.0, row_s, row[:, 1]) for row_s, row in zip(s, grid, strict=True)]
        lines.append(np.stack([x, height, np.full_like(x, z)], axis=1))
    points = np.concatenate(lines)
    points = points - points.mean(axis=0)
    return float(np.abs(points @ np.linalg.svd(points)[2][2]).max())
