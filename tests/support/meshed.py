"""A mesh of a cloud in one call, as a scan makes it in two."""

from __future__ import annotations

from typing import Any

from bodyscan.fusion.meshing import attach_attributes, make_closed_surface
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.settings import MeshSettings


def mesh(cloud: BodyCloud, settings: MeshSettings, *seen: Any) -> BodyMesh:
    """seen: range images as measured, and their poses."""
    return attach_attributes(*make_closed_surface(cloud, settings, *seen), cloud, settings.reach_mm)
