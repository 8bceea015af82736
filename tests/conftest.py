"""What every test may use."""

from __future__ import annotations

import os

# As the command line does: stages share the cores out, BLAS threads inside them only get in the way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path

import pytest
from hypothesis import settings
from ray_cast_scan import Scan, cast_scan, load_body, load_rig

from bodyscan.fusion.cleaning import clean
from bodyscan.fusion.merging import merge
from bodyscan.fusion.meshing import mesh
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import FusionSettings, MeshSettings

# What is compiled is compiled at its first call, and machines may be loaded.
settings.register_profile("bodyscan", deadline=None)
settings.load_profile("bodyscan")

PROJECT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of real captures; tests that need it say so when it is not there."""
    folder = Path(os.environ.get("BODYSCAN_CAPTURES", PROJECT.parent / "shared" / "captures"))
    if not folder.is_dir():
        pytest.skip(f"real captures not found at {folder} (set BODYSCAN_CAPTURES)")
    return folder


@pytest.fixture(scope="session")
def scan() -> Scan:
    return cast_scan(load_body(), load_rig(), scale=0.5)


@pytest.fixture(scope="session")
def cleaned(scan: Scan) -> list[RangeImage]:
    return clean(scan.range_images, scan.rig_from_camera, load_rig().volume)


@pytest.fixture(scope="session")
def cloud(scan: Scan, cleaned: list[RangeImage]) -> BodyCloud:
    return merge(cleaned, scan.rig_from_camera, FusionSettings(points=250_000)).cloud


@pytest.fixture(scope="session")
def body(scan: Scan, cloud: BodyCloud) -> BodyMesh:
    return mesh(cloud, MeshSettings(depth=8), scan.range_images, scan.rig_from_camera)
