"""A small scan result on disk, with every kind of thing that a report shows."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from made_bodies import ellipsoid, mesh_of

from bodyscan.files.atomic import write_json
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.ply import write_ply

SEMI_AXES_MM = np.array([120.0, 180.0, 850.0])
MIDDLE_MM = np.array([15.0, -20.0, 870.0])
SOLES_MM = 60.0


@dataclass(frozen=True)
class MadeScan:
    folder: Path
    mesh: BodyMesh
    cloud: BodyCloud


def egg(resolution: int = 60, grown_mm: float = 0.0) -> BodyMesh:
    """An egg as tall as a person, its lowest part made up; grown: larger on all sides by so much."""
    vertices, faces = ellipsoid(SEMI_AXES_MM + grown_mm, MIDDLE_MM, resolution)
    sigma = (0.03 + 0.05 * (vertices[:, 1] > 0)).astype(np.float32)
    sigma[vertices[:, 2] < SOLES_MM] = np.nan
    tint = np.clip(255 * (vertices - vertices.min(axis=0)) / np.ptp(vertices, axis=0), 0, 255)
    return mesh_of(vertices, faces, colours=tint, sigma_mm=sigma)


def make_scan(folder: Path, subject: str = "s-17", grown_mm: float = 0.0) -> MadeScan:
    """Write what `bodyscan scan` writes."""
    mesh = egg(grown_mm=grown_mm)
    known = np.isfinite(mesh.sigma_mm)
    cloud = BodyCloud(
        mesh.vertices[known],
        mesh.normals[known],
        mesh.sigma_mm[known],
        mesh.colours[known],
        (1 + np.arange(known.sum()) % 4).astype(np.uint8),
    )
    write_ply(folder / "cloud.ply", cloud)
    write_ply(folder / "mesh.ply", mesh)
    names = ("cloud.ply", "mesh.ply")
    overlap = {"points": 900, "rms_before_mm": 0.21, "rms_after_mm": 0.13}
    facts = {
        "schema": "bodyscan-scan",
        "version": 1,
        "software": "bodyscan 0.1.0",
        "subject": subject,
        "when": "2026-11-21T10:00:00",
        "calibration_id": "0123456789abcdef",
        "sha256": {
            name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names
        },
        "counts": {},
        "person": {
            "parts": [{"name": "left arm", "moved_mm": 4.61, "left_mm": 0.17, "seen_once": 0.25}],
            "breathed_mm": 2.2,
            "moment_ms": 1041.7,
            "fuller_mm": -1.26,
            "fuller_sigma_mm": 0.42,
        },
        "verdict": {"grade": "usable", "reasons": ["the person moved by 3.4 mm </script><b>"]},
        "measured": {"p1-1": 1000, "p1-2": 1200, "p2-1": 0},
        "failed": {"p2-1": "no light"},
        "alignment": {
            "rms_before_mm": 0.21,
            "rms_after_mm": 0.13,
            "motion_mm": {"p1-1": 3.4, "p1-2": 0.2},
            "refused": {},
            "overlaps": [
                {"source": "p1-1", "target": "p1-2", **overlap},
                {"source": "p1-2", "target": "p1-1", **overlap},
            ],
        },
    }
    write_json(folder / "scan.json", facts)
    return MadeScan(folder, mesh, cloud)
