"""One small scan of a body, made once: half-size images, so that a pixel is 1.4 mm."""

from __future__ import annotations

import pytest
from ray_cast_scan import Scan, cast_scan, load_body, load_rig

from bodyscan.fusion.body import BodyCloud, BodyMesh
from bodyscan.fusion.cleaning import clean
from bodyscan.fusion.merging import merge
from bodyscan.fusion.meshing import mesh
from bodyscan.reconstruction.range_image import RangeImage


@pytest.fixture(scope="session")
def scan() -> Scan:
    return cast_scan(load_body(), load_rig(), scale=0.5)


@pytest.fixture(scope="session")
def cleaned(scan: Scan) -> list[RangeImage]:
    return clean(scan.range_images, scan.rig_from_camera, load_rig().volume)


@pytest.fixture(scope="session")
def cloud(scan: Scan, cleaned: list[RangeImage]) -> BodyCloud:
    return merge(cleaned, scan.rig_from_camera, points=250_000)


@pytest.fixture(scope="session")
def body(scan: Scan, cloud: BodyCloud) -> BodyMesh:
    return mesh(cloud, scan.range_images, scan.rig_from_camera, depth=8)
