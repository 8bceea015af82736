"""What every test may use."""

from __future__ import annotations

import gc
import os

# As the command line does: stages share the cores out, BLAS threads inside them only get in the way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Workers share the cores out as well: OpenCV's threads wait for one another, a twentieth of its time.
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings
from made_once import value_made_once
from required import IN_CI, missing
from slow_files import SLOW

from bodyscan.memory import keep_freed_memory

# What is heavy is imported where it is used: the process that hands tests out reads this file as well,
# before any worker begins.
if TYPE_CHECKING:
    from ray_cast_scan import Scan

    from bodyscan.mesh.body import BodyCloud, BodyMesh
    from bodyscan.reconstruction.range_image import RangeImage

# What is compiled is compiled at its first call, and machines may be loaded. In CI the same examples
# are tried every time, so that a change is judged by itself; elsewhere new ones are looked for.
settings.register_profile("bodyscan", deadline=None, derandomize=IN_CI)
settings.register_profile("quick", settings.get_profile("bodyscan"), max_examples=20)
settings.load_profile("bodyscan")

PROJECT = Path(__file__).parents[1]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays: looking through it for garbage is a third of the start,
    in every worker, and goes on in every test. Freed memory stays as well, as in commands: fetching it
    again is a twentieth of what tests with images take."""
    keep_freed_memory()
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow files first, then those with some slow tests; the quick ones fill the end evenly."""
    partly = {item.path for item in items if item.get_closest_marker("slow")}

    def place(item: pytest.Item) -> int:
        path = item.path.relative_to(Path(__file__).parent).as_posix()
        return SLOW.index(path) if path in SLOW else len(SLOW) + (item.path not in partly)

    for item in items:
        if place(item) < len(SLOW):
            item.add_marker(pytest.mark.slow)
    items.sort(key=place)


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of real captures; without it, tests that need it are skipped, in CI failed."""
    folder = Path(os.environ.get("BODYSCAN_CAPTURES", PROJECT.parent / "shared" / "captures"))
    if not folder.is_dir():
        missing(f"real captures not found at {folder} (set BODYSCAN_CAPTURES)")
    return folder


@pytest.fixture(scope="session")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    from ray_cast_scan import cast_scan, load_body, load_rig

    return value_made_once(
        tmp_path_factory, "scan", lambda: cast_scan(load_body(), load_rig(), scale=0.5)
    )


@pytest.fixture(scope="session")
def cleaned(scan: Scan, tmp_path_factory: pytest.TempPathFactory) -> list[RangeImage]:
    from ray_cast_scan import load_rig

    from bodyscan.fusion.cleaning import clean

    def make() -> list[RangeImage]:
        return clean(scan.range_images, scan.rig_from_camera, load_rig().volume)

    return value_made_once(tmp_path_factory, "cleaned", make)


@pytest.fixture(scope="session")
def cloud(
    scan: Scan, cleaned: list[RangeImage], tmp_path_factory: pytest.TempPathFactory
) -> BodyCloud:
    from bodyscan.fusion.merging import merge
    from bodyscan.settings import FusionSettings

    def make() -> BodyCloud:
        return merge(cleaned, scan.rig_from_camera, FusionSettings(points=250_000)).cloud

    return value_made_once(tmp_path_factory, "cloud", make)


@pytest.fixture(scope="session")
def body(scan: Scan, cloud: BodyCloud, tmp_path_factory: pytest.TempPathFactory) -> BodyMesh:
    from meshed import mesh

    from bodyscan.settings import MeshSettings

    def make() -> BodyMesh:
        return mesh(cloud, MeshSettings(depth=8), scan.range_images, scan.rig_from_camera)

    return value_made_once(tmp_path_factory, "body", make)
