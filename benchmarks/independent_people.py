"""People whom another renderer made, scanned by the real commands and scored against their truth.

BODYSCAN_PEOPLE names their folder (../shared/people if it is not set); its README says how bodies,
motion, light and cameras were made. This scorer is our own; the folder's `score_people.py` shares
no line with it, and both should give the same figures.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import yaml
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from benchmarks.full_size import PROJECT, run_commands
from bodyscan.arrays import Array, Indices, Mask
from bodyscan.fusion.storage import load_scan

PEOPLE = Path(os.environ.get("BODYSCAN_PEOPLE", PROJECT.parent / "shared" / "people"))
PARTS = ("head", "trunk", "arms", "legs")
HAIR = 2


@dataclass(frozen=True, eq=False)
class TruePerson:
    """The truth of a set: its mesh in the rig's frame.

    faces: (F, 3).
    vertices: (N, 3) mm, at the middle of the scan.
    at_mean_breath: (N, 3) mm, at mean breath, the trunk where it is at the middle of the scan.
    part, region: (N,) index into PARTS; 1 skin, 2 hair, 3 cloth.
    """

    faces: Indices
    vertices: Array
    at_mean_breath: Array
    part: Indices
    region: Indices


def report() -> str:
    """The section of docs/results.md: two people, with and without the times of their frames."""
    rows, girths = [], []
    for person in ("heavy_man", "woman"):
        truth = load_truth(PEOPLE / person / "truth")
        for timed in (True, False):
            with tempfile.TemporaryDirectory(prefix="bodyscan-") as folder:
                one, other = _score(person, truth, Path(folder), timed=timed)
            name = f"{person}, {'with' if timed else 'without'} times"
            rows.append(f"| {name} | {one} |")
            girths.append(f"| {name} | {other} |")
    first = (
        "all: RMS, 95 %",
        "without hair: RMS, 95 %",
        *("arms", "trunk", "legs", "head", "hair: RMS, bias"),
        "error / sigma: without hair; arms, trunk, legs, head",
        "beyond",
    )
    second = ("girths: RMS, worst mm", "inside", "`scan` s", "times OpenCV's reading", "verdict")
    return f"""## People whom an independent program rendered (synthetic)

Two living people of 12 pairs each, rendered by a program that shares no code with this one, scanned by
`bodyscan scan` and `bodyscan measure` in fresh processes. The cloud is laid rigidly on the true mesh
at the middle of the scan; signed distances in mm, those beyond 10 mm (last column) left out. Parts
are without hair.

{_table(first, rows)}

Girths of the trunk (tape) every 25 mm from crotch to armpits against the true ones at mean breath:
RMS and worst of those measured to 85 % or more; the share of all inside their 95 % intervals.
Seconds of the scan, and their ratio to OpenCV's reading of the same images one by one.

{_table(second, girths)}
"""


def _table(heading: tuple[str, ...], rows: list[str]) -> str:
    return "\n".join([f"| set | {' | '.join(heading)} |", "|---" * (len(heading) + 1) + "|", *rows])


def _score(person: str, truth: TruePerson, folder: Path, *, timed: bool) -> tuple[str, str]:
    """Scan a person into a folder; the cells of both tables."""
    captures = _captures(PEOPLE / person / "scan", folder / "captures", timed=timed)
    heights, result = _girth_heights(truth), folder / "result"
    calibration = PEOPLE / person / "calibration"
    _, seconds, _ = run_commands(
        {
            "scan": [captures, "--calibration", calibration, "--out", result],
            "measure": [result, "--heights", ",".join(f"{h:.0f}" for h in heights), "--anyway"],
        },
        folder,
    )
    scan = load_scan(result)
    points, sigma = scan.cloud.points.astype(float), scan.cloud.sigma_mm.astype(float)
    truth_from_scan = align_to_truth(points, truth)
    moved = points @ truth_from_scan[:3, :3].T + truth_from_scan[:3, 3]
    cells = _distance_cells(moved, sigma, truth)
    measured = json.loads((result / "measurements.json").read_text("utf-8"))
    girths = _girth_cells(measured, truth, np.linalg.inv(truth_from_scan))
    speed = f"{seconds['scan']:.1f} | {seconds['scan'] / _reading_seconds(captures):.1f}"
    return cells, f"{girths} | {speed} | {scan.facts['verdict']['grade']}"


def _captures(scan: Path, folder: Path, *, timed: bool) -> Path:
    """The scan's captures, its images where they lie, without `timing` unless it is `timed`."""
    if timed:
        return scan
    folder.mkdir()
    facts = yaml.safe_load((scan / "captures.yaml").read_text("utf-8"))
    facts.pop("timing", None)
    (folder / "captures.yaml").write_text(json.dumps(facts), "utf-8")
    for shot in (path for path in scan.iterdir() if path.is_dir()):
        shutil.copytree(shot, folder / shot.name)
    return folder


def _reading_seconds(captures: Path) -> float:
    """Seconds in which OpenCV reads all images, one after another, in a process of its own."""
    code = "import cv2,sys,time;s=time.perf_counter();[cv2.imread(p,0) for p in sys.argv[1:]]"
    images = sorted(str(path) for path in captures.rglob("*.png"))
    line = [sys.executable, "-c", f"{code};print(time.perf_counter()-s)", *images]
    return float(subprocess.run(line, capture_output=True, text=True, check=True).stdout)


def load_truth(folder: Path) -> TruePerson:
    """Read truth/meshes.npz and truth/motion.npz as the people's README describes them."""
    meshes, motion = np.load(folder / "meshes.npz"), np.load(folder / "motion.npz")
    faces, count = meshes["base_faces"].astype(np.int64), int(meshes["base_faces"].max()) + 1
    for _ in range(int(meshes["rounds"])):
        faces, count = _subdivide(faces, count)
    neutral, turn, shift = meshes["neutral"].astype(float), motion["middle_R"], motion["middle_t"]
    moved = neutral + meshes["middle_um"] / 1000.0
    return TruePerson(
        faces,
        moved @ turn.T + shift,
        neutral @ turn.T + shift,
        meshes["part"].astype(np.int64),
        meshes["region"].astype(np.int64),
    )


def _subdivide(faces: Indices, count: int) -> tuple[Indices, int]:
    """Split each of F faces at its edges' midpoints, numbered from `count` in the edges' order."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
    edges, number = np.unique(ends, axis=0, return_inverse=True)
    ab, bc, ca = (count + number.reshape(-1, 3)).T
    a, b, c = faces.T
    split = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(corners, axis=1) for corners in split]), count + len(edges)


def _scene(truth: TruePerson) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(truth.vertices.astype(np.float32), truth.faces.astype(np.uint32))
    return scene


def _closest(scene: Any, points: Array) -> tuple[Array, Array, Indices]:
    """Closest points (N, 3) on a mesh, unit normals (N, 3) and faces (N,) there."""
    found = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
    normals = found["primitive_normals"].numpy().astype(float)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return found["points"].numpy().astype(float), normals, found["primitive_ids"].numpy()


def align_to_truth(points: Array, truth: TruePerson) -> Array:
    """Find the rigid motion (4, 4) of the cloud to the truth: robust point-to-plane ICP."""
    scene, result = _scene(truth), np.eye(4)
    rng = np.random.default_rng(0)
    few = points[rng.choice(len(points), min(len(points), 40_000), replace=False)]
    for step in range(30):
        moved = few @ result[:3, :3].T + result[:3, 3]
        on, normals, _ = _closest(scene, moved)
        residual = np.sum(normals * (moved - on), axis=1)
        # Tukey's biweight, whose limit shrinks to 4.7 robust standard deviations.
        limit = max(30.0 * 0.7**step, 1.0, 4.7 * 1.4826 * float(np.median(np.abs(residual))))
        weight = np.clip(1.0 - (residual / limit) ** 2, 0.0, None)
        centre = moved.mean(axis=0)
        rows = np.hstack([np.cross(moved - centre, normals), normals]) * weight[:, None]
        twist = np.linalg.lstsq(rows, -residual * weight, rcond=None)[0]
        change = np.eye(4)
        change[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
        change[:3, 3] = centre + twist[3:] - change[:3, :3] @ centre
        result = change @ result
    return result


def measure_distances(points: Array, truth: TruePerson) -> tuple[Array, Indices]:
    """Signed distances (N,) of points to the true mesh, outside positive, and nearest vertices."""
    on, _, face = _closest(_scene(truth), points)
    off = points - on
    # A vertex normal decides the side: at a closest point on an edge a face's may not.
    near = truth.faces[face][np.arange(len(face)), _nearest_corner(points, truth, face)]
    distance = np.linalg.norm(off, axis=1)
    distance *= np.where(np.sum(off * _vertex_normals(truth)[near], axis=1) < 0.0, -1.0, 1.0)
    return distance, near


def measure_rms_without_hair(points: Array, truth: TruePerson) -> float:
    """Lay points (N, 3) on the true mesh; RMS distance where there is no hair, mm."""
    truth_from_scan = align_to_truth(points, truth)
    moved = points @ truth_from_scan[:3, :3].T + truth_from_scan[:3, 3]
    distance, near = measure_distances(moved, truth)
    kept = (np.abs(distance) < 10.0) & (truth.region[near] != HAIR)
    return float(np.sqrt(np.mean(distance[kept] ** 2)))


def _distance_cells(points: Array, sigma: Array, truth: TruePerson) -> str:
    """Cells of the first table for a cloud that lies on the truth."""
    distance, near = measure_distances(points, truth)
    close, hair = np.abs(distance) < 10.0, truth.region[near] == HAIR
    masks = [
        ~hair & (truth.part[near] == PARTS.index(p)) for p in ("arms", "trunk", "legs", "head")
    ]

    def rms(mask: Mask, values: Array = distance) -> float:
        return float(np.sqrt(np.mean(values[mask & close] ** 2)))

    def both(mask: Mask) -> str:
        return f"{rms(mask):.3f}, {np.percentile(np.abs(distance[mask & close]), 95.0):.3f}"

    scaled = distance / sigma
    parts = " | ".join(f"{rms(mask):.3f}" for mask in masks)
    ratios = " ".join(f"{rms(mask, scaled):.1f}" for mask in masks)
    of_hair = f"{rms(hair):.2f}, {distance[hair & close].mean():+.2f}" if hair.any() else ""
    return (
        f"{both(np.ones_like(hair))} | {both(~hair)} | {parts} | {of_hair} | "
        f"{rms(~hair, scaled):.1f}; {ratios} | {100.0 * np.mean(~close):.2f} %"
    )


def _nearest_corner(points: Array, truth: TruePerson, face: Indices) -> Indices:
    corners = truth.vertices[truth.faces[face]]
    return np.asarray(np.argmin(np.sum((corners - points[:, None]) ** 2, axis=-1), axis=1))


def _vertex_normals(truth: TruePerson) -> Array:
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(truth.vertices), o3d.utility.Vector3iVector(truth.faces)
    )
    return np.asarray(mesh.compute_vertex_normals().vertex_normals)


def _section(vertices: Array, faces: Indices, z: float) -> tuple[float, bool]:
    """Tape (mm) around the widest loop of a mesh at height z, and whether it is closed and alone."""
    above = vertices[:, 2] > z
    cut = faces[(above[faces].sum(axis=1) % 3) != 0]
    ends = np.sort(np.stack([cut, np.roll(cut, -1, axis=1)], axis=-1), axis=-1)
    crossing = above[ends[..., 0]] != above[ends[..., 1]]
    edges, number = np.unique(ends[crossing], axis=0, return_inverse=True)
    if len(edges) < 12:
        return np.nan, False
    links = number.reshape(-1, 2)  # each cut face crosses two edges
    low, high = vertices[edges[:, 0]], vertices[edges[:, 1]]
    share = (z - low[:, 2]) / (high[:, 2] - low[:, 2])
    outline = (low + share[:, None] * (high - low))[:, :2]
    graph = coo_matrix((np.ones(len(links)), links.T), shape=(len(edges), len(edges)))
    _, loop = connected_components(graph, directed=False)
    degree = np.bincount(links.ravel(), minlength=len(edges))
    tapes = {k: ConvexHull(outline[loop == k]).area for k in np.unique(loop) if sum(loop == k) > 8}
    if not tapes:
        return np.nan, False
    widest = max(tapes, key=lambda k: tapes[k])
    alone = all(tape < 0.3 * tapes[widest] for k, tape in tapes.items() if k != widest)
    return tapes[widest], alone and bool(np.all(degree[loop == widest] == 2))


def _trunk_faces(truth: TruePerson) -> Indices:
    arm = truth.part == PARTS.index("arms")
    return truth.faces[~arm[truth.faces].any(axis=1)]


def _girth_heights(truth: TruePerson) -> Array:
    """Heights (mm) every 25 mm from crotch to armpits, where the trunk's section is one loop."""
    faces, top = _trunk_faces(truth), float(truth.at_mean_breath[:, 2].max())
    run: list[float] = []
    for z in np.arange(25.0 * np.ceil(0.4 * top / 25.0), 0.9 * top, 25.0):
        if _section(truth.at_mean_breath, faces, z)[1]:
            run.append(float(z))
        elif len(run) > 4:
            break
        else:
            run = []
    return np.array(run)


def _girth_cells(measured: dict[str, Any], truth: TruePerson, scan_from_truth: Any) -> str:
    """Errors of trunk girths against mean breath, and how many intervals hold the truth."""
    vertices = truth.at_mean_breath @ scan_from_truth[:3, :3].T + scan_from_truth[:3, 3]
    faces, errors, inside = _trunk_faces(truth), [], []
    for one in measured["slices"]:
        trunks = [girth for girth in one["girths"] if girth["part"] == "trunk"]
        true, closed = _section(vertices, faces, one["height_mm"])
        if not trunks or not closed:
            continue
        girth = max(trunks, key=lambda item: item["tape_mm"])
        margin = 1.96 * (girth.get("breath_sigma_mm") or 0.0)
        low, high = girth.get("tape_range_mm") or (girth["tape_mm"],) * 2
        inside.append(low - margin <= true <= high + margin)
        if girth["measured"] >= 0.85:
            errors.append(girth["tape_mm"] - true)
    off = np.array(errors)
    worst = off[np.argmax(np.abs(off))]
    return f"{np.sqrt(np.mean(off**2)):.2f}, {worst:+.2f} | {100.0 * np.mean(inside):.0f} %"
