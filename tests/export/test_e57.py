"""Raw clouds as E57, read back by the library's own reader."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodyscan.errors import BadInput
from bodyscan.export.e57 import write_e57
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.triangulation import estimate_grid_normals

CAMERA = Camera(100.0, 100.0, 0.0, 20.0, 15.0, Radial(), 40, 30)
RIG_FROM_CAMERA = RigidTransform.from_rotation_vector([0.3, -1.1, 0.4], [650.0, -1120.0, 900.0])


def image(pair: str, visible: bool = True) -> RangeImage:
    """A slanted plane about 1.3 m away, with a hole."""
    rays = CAMERA.pixel_rays()
    points = (rays * (1300.0 + 200.0 * rays[..., :1])).astype(np.float32)
    points[5:9, 10:20] = np.nan
    if not visible:
        points[:] = np.nan
    sigma = np.where(np.isfinite(points[..., 0]), 0.1, np.nan).astype(np.float32)
    grey = np.arange(CAMERA.width * CAMERA.height).reshape(points.shape[:2]).astype(np.uint8)
    return RangeImage(pair, CAMERA, points, estimate_grid_normals(points), sigma, grey)


def test_points_pose_and_colour_come_back(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "raw.e57"
    one = image("p1-1")
    rgb = np.dstack([one.colours[::-1], one.colours, one.colours // 2])
    one = replace(one, rgb=rgb)
    poses = {"p1-1": RIG_FROM_CAMERA, "p1-2": RigidTransform.identity(), "p1-3": RIG_FROM_CAMERA}
    counts = write_e57(path, [one, image("p1-2"), image("p1-3", visible=False)], poses)
    assert counts == {"p1-1": 1160, "p1-2": 1160, "p1-3": 0}
    file = pye57.E57(str(path))
    assert file.scan_count == 2
    read = file.read_scan(0, colors=True, row_column=True, ignore_missing_fields=True)
    world = np.stack([read[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
    expected = RIG_FROM_CAMERA.apply(one.points[one.valid].astype(float)) / 1000.0
    np.testing.assert_allclose(world, expected, atol=1e-6)  # written as float32: 0.1 um at 1 m
    for channel, name in enumerate(("Red", "Green", "Blue")):
        np.testing.assert_array_equal(read[f"color{name}"], rgb[one.valid][:, channel])
    grey = file.read_scan(1, colors=True, ignore_missing_fields=True)
    np.testing.assert_array_equal(grey["colorBlue"], one.colours[one.valid])
    np.testing.assert_array_equal(
        np.stack([read["rowIndex"], read["columnIndex"]]), np.nonzero(one.valid)
    )
    assert file.get_header(0)["name"].value() == "p1-1"


def test_without_the_library_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(BadInput, match=r"bodyscan\[e57\]"):
        write_e57(tmp_path / "raw.e57", [], {})
    assert not list(tmp_path.iterdir())
