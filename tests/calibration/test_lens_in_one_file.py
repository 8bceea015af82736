"""A lens is one class in one file: everything a rig does with cameras goes through with a new one."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig, ring_views
from table_one import POINTS, TURNS

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.camera import calibrate_camera
from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.errors import BadInput
from bodyscan.export.rig import export_rig
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import (
    look_up,
    look_up_rays,
    make_projection_table,
    make_ray_table,
)
from bodyscan.geometry.lenses import LENSES
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.rig_solve import solve_rig
from bodyscan.registration.storage import load_calibration, save_calibration


@dataclass(frozen=True)
class Leaning(Lens):
    """A lens whose elements are not square to its axis: real = ideal + t (2 x y, r^2 + 2 y^2)."""

    t: float = 0.0

    kind: ClassVar[str] = "leaning"

    @property
    def prior_sigmas(self) -> Array:
        return np.array([0.05])

    def distort(self, ideal: Array) -> Array:
        return ideal + self.t * self.by_coefficients(ideal)[..., 0]

    def by_coefficients(self, ideal: Array) -> Array:
        x, y = ideal[..., 0], ideal[..., 1]
        return np.stack([2.0 * x * y, x * x + 3.0 * y * y], axis=-1)[..., None]

    def by_point(self, ideal: Array) -> Array:
        x, y = ideal[..., 0], ideal[..., 1]
        rows = [1.0 + 2.0 * self.t * y, 2.0 * self.t * x, 2.0 * self.t * x, 1.0 + 6.0 * self.t * y]
        return np.stack(rows, axis=-1).reshape(*x.shape, 2, 2)


CAMERA = Camera(1061.7, 1064.1, -0.6, 330.0, 250.0, Leaning(0.02), 640, 480)
Ring = tuple[dict[str, RigidTransform], dict[str, Camera]]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LENSES, Leaning.kind, Leaning)


def views() -> list[PlanarView]:
    turns = [RigidTransform.from_rotation_vector(turn, [-90.0, -70.0, 400.0]) for turn in TURNS]
    return [
        PlanarView(str(k), POINTS, CAMERA.project(p.apply(POINTS))) for k, p in enumerate(turns)
    ]


def test_its_camera_is_calibrated() -> None:
    found = calibrate_camera(views(), 640, 480, Leaning())
    assert found.camera.parameter_names[5:] == ("t",)
    assert found.camera.parameters == pytest.approx(CAMERA.parameters, rel=1e-6, abs=1e-5)
    assert found.covariance.shape == (6, 6)
    # The chapter's lens cannot bend the image so.
    assert calibrate_camera(views(), 640, 480).rms_px > 0.2


def test_its_rays_are_tabulated() -> None:
    wanted = np.zeros((480, 640), bool)
    wanted[::40, ::40] = True
    rows, columns = np.nonzero(wanted)
    pixels = np.column_stack([columns, rows]).astype(float)
    rays = look_up_rays(make_ray_table(CAMERA), wanted)
    assert np.abs(CAMERA.project(rays) - pixels).max() < 1e-3
    found = [look_up(make_projection_table(CAMERA), x, y) for x, y, _ in CAMERA.rays(pixels)]
    assert np.abs(np.array(found) - pixels).max() < 1e-3


@pytest.fixture(scope="module")
def ring() -> Ring:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    first = next(iter(cameras))
    c = cameras[first]
    # One pair with the new lens among pairs with the chapter's.
    own = Camera(c.alpha, c.beta, c.gamma, c.u0, c.v0, Leaning(0.01), c.width, c.height)
    return placings, cameras | {first: own}


def test_its_pair_is_placed_among_others(ring: Ring) -> None:
    placings, cameras = ring
    views, _ = ring_views(placings, cameras, shots=20)
    placed = solve_rig(ring_rig(placings), views, cameras).value
    for name, placing in placings.items():
        assert np.linalg.norm(placed.rig_from_camera[name].translation - placing.translation) < 0.7
        assert placed.cameras[name].lens.kind == cameras[name].lens.kind
    first = next(iter(cameras))
    lens = placed.cameras[first].lens
    assert isinstance(lens, Leaning)
    assert lens.t == pytest.approx(0.01, abs=2e-4)


def test_its_calibration_is_read_as_it_was_written(ring: Ring, tmp_path: Path) -> None:
    placings, cameras = ring
    pairs = {
        name: PairCalibration(name, c, np.eye(len(c.parameters)), None, PairQuality(0.1, 9))
        for name, c in cameras.items()
    }
    covariance = PoseCovariance(tuple(pairs), np.eye(6 * len(pairs)))
    calibration = RigCalibration(ring_rig(placings), pairs, placings, covariance, {}, {}, ())
    found = load_calibration(save_calibration(calibration, tmp_path))
    assert {name: pair.camera for name, pair in found.pairs.items()} == cameras
    assert {type(pair.camera.lens) for pair in found.pairs.values()} == {Leaning, Radial}
    with pytest.raises(BadInput, match="no lens like 'leaning'"):
        export_rig(calibration, tmp_path, ["opencv"])
