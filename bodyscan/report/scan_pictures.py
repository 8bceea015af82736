"""The pictures that a scan leaves beside its result."""

from __future__ import annotations

from pathlib import Path

from bodyscan.fusion.scan import Scan
from bodyscan.report.pictures import draw_cloud, draw_mesh


def draw_scan(scan: Scan, folder: Path) -> list[Path]:
    """Cloud by photo, sigma and number of pairs, and the mesh with its filled faces marked."""
    paths = [folder / f"{name}.png" for name in ("cloud", "sigma", "pairs", "mesh")]
    draw_cloud(scan.cloud, paths[0], colour="photo")
    draw_cloud(scan.cloud, paths[1], colour="sigma")
    draw_cloud(scan.cloud, paths[2], colour="pairs_seen")
    draw_mesh(scan.mesh, paths[3], colour="filled")
    return paths
