"""Projectors with a lens: each pair of a rig on a body,
compared with a perfect calibration of it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.calibration.pair import PairCalibration
from bodyscan.captures.folder import open_captures, open_scan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.storage import load_calibration
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.simulation import SimulationSettings, simulate
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.projector import PinholeProjector
from bodyscan.simulation.settings import Projection
from bodyscan.workflows.decode import decode_sequence
from bodyscan.workflows.evaluate import load_truth

PROJECT = Path(__file__).parents[1]
WORKSPACE = PROJECT / "bench" / "lens"
LENS_K1 = -0.035
FEW_BOARDS = 2
HEAD = (
    "| pair | light | true | ours | ratio | ratio in the rig | true, aligned | ours, aligned | ratio "
    "| pixels of few boards | ratio |\n" + "|---" * 11 + "|"
)
ROUNDS, OUTLIER = 3, 6.0
ON_BODY_MM = 20.0
MOST_PIXELS = 6000


@dataclass(frozen=True)
class Errors:
    """Absolute distances from the body, mm."""

    median: float
    rms: float

    @staticmethod
    def of(distances: Array) -> Errors:
        if not distances.size:
            return Errors(np.nan, np.nan)
        return Errors(float(np.median(np.abs(distances))), float(np.sqrt(np.mean(distances**2))))

    def over(self, other: Errors) -> str:
        return f"{self.median / other.median:.2f}, {self.rms / other.rms:.2f}"

    def __str__(self) -> str:
        return f"{self.median:.4f}, {self.rms:.4f}"


def report() -> str:
    """The section of docs/results.md."""
    make_data(WORKSPACE)
    rows = pair_rows(WORKSPACE, WORKSPACE / "calibration")
    return f"""## Projectors with a lens (synthetic)

`python -m benchmarks lens`: `rigs/three-pole-12.yaml` at half size, 640 x 512 px and 320 stripes,
projectors with a lens (k1 about {LENS_K1}), calibrated by `calibrate-rig`. The person's stripe map of
each pair becomes points twice: by our calibration, and by the true camera and the true projector.
Distances of the same pixels' points to the true body, each in its own camera frame, mm (median, RMS),
and ours over the truth's;
"in the rig": ours as the rig places it; "aligned": after each has been moved rigidly to fit the
body; "few boards": pixels of stripes that at most {FEW_BOARDS} boards reached, aligned.

What is left before aligning is where the camera's own frame lies: corners tell the principal point
to about 0.15 px and the focal length to 1e-4, which turns and shifts the frame by 0.1 mrad and 0.1 mm
without changing its points' shape; the rig's solve, which finds each camera's place with the same
intrinsics, takes up most of it.

{HEAD}
{chr(10).join(rows)}
"""


def make_data(workspace: Path) -> None:
    """Simulate and calibrate what does not exist yet."""
    if not (workspace / "truth" / "truth.json").exists():
        lens = Projection(kind="pinhole", k1=LENS_K1, k2=0.0)
        simulate(
            PROJECT / "rigs" / "three-pole-12.yaml",
            workspace,
            subject=PROJECT / "data" / "subjects" / "woman_average.ply",
            scale=0.5,
            settings=replace(SimulationSettings(), projection=lens),
        )
    if not (workspace / "calibration" / "calibration.json").exists():
        line = [sys.executable, "-m", "bodyscan", "calibrate-rig", str(workspace / "rig.yaml")]
        subprocess.run(line, check=True, stdout=subprocess.DEVNULL)


def pair_rows(workspace: Path, calibration_folder: Path) -> list[str]:
    """A row of the table for each pair, and one for all pixels together."""
    calibration, truth = load_calibration(calibration_folder), load_truth(workspace / "truth")
    assert truth.vertices is not None
    assert truth.faces is not None
    body = Body(truth.vertices, truth.faces)
    scan = open_scan(calibration.rig, workspace / "captures" / "person")
    rig = load_rig(workspace / "rig.yaml")
    shots = striped_shots(rig, workspace)
    rows, whole = [], []
    for sequence in scan.sequences:
        pair, facts = calibration.pairs[sequence.pair], truth.facts["pairs"][sequence.pair]
        stripes = decode_sequence(sequence, calibration.rig.pair(sequence.pair))
        v, u = np.nonzero(np.isfinite(stripes.s))
        found = _measured(
            pair, facts, np.column_stack([u, v]).astype(float), stripes.s[v, u].astype(float)
        )
        body_from_camera = RigidTransform.from_matrix(facts["rig_from_camera"])
        found = found.on_body(body, body_from_camera)
        few = boards_reached(rig, truth.facts, sequence.pair, shots, found.s) <= FEW_BOARDS
        sets = []
        for points in (found.true, found.ours):
            placed = body_from_camera.apply(points)
            sets += [body.distances(placed)[0], body.distances(body.aligned(placed))[0]]
        in_rig = calibration.rig_from_camera[sequence.pair].apply(found.ours)
        sets.append(body.distances(in_rig)[0])
        whole.append(sets)
        rows.append(_row(sequence.pair, pair.quality.light_model or "", sets, few))
    every = [np.concatenate(part) for part in zip(*whole, strict=True)]
    return [*rows, _row("all", "", every, np.zeros(len(every[0]), bool))]


def _row(name: str, model: str, sets: list[Array], few: Mask) -> str:
    true, true_aligned, ours, ours_aligned, in_rig = map(Errors.of, sets)
    few_true, few_ours = Errors.of(sets[1][few]), Errors.of(sets[3][few])
    return (
        f"| {name} | {model} | {true} | {ours} | {ours.over(true)} | {in_rig.over(true)} | "
        f"{true_aligned} | {ours_aligned} | {ours_aligned.over(true_aligned)} | {few.sum()} | "
        f"{few_ours.over(few_true) if few.any() else ''} |"
    )


@dataclass(frozen=True, eq=False)
class _Measured:
    """s (N,) of the pixels measured by both; points (N, 3) of each in its own camera frame, mm."""

    s: Array
    ours: Array
    true: Array

    def on_body(self, body: Body, body_from_camera: RigidTransform) -> _Measured:
        """A sample of the pixels that see the body rather than what is behind it."""
        on = body.struck(body_from_camera, self.true)
        chosen = np.flatnonzero(on)[:: max(1, int(on.sum()) // MOST_PIXELS)]
        return _Measured(self.s[chosen], self.ours[chosen], self.true[chosen])


def _measured(pair: PairCalibration, facts: dict[str, Any], pixels: Array, s: Array) -> _Measured:
    assert pair.sheets is not None
    rays = pair.camera.rays(pixels)
    ours = rays * pair.sheets.intersect(rays, s).depth[:, None]
    true_rays = TrueCamera(**facts["camera"]).directions(pixels)
    true = true_rays * true_depth(true_projector(facts), true_rays, s)[:, None]
    known = np.isfinite(ours[:, 2]) & np.isfinite(true[:, 2])
    return _Measured(s[known], ours[known], true[known])


def true_projector(facts: dict[str, Any]) -> PinholeProjector:
    """A pair's projector from truth.json."""
    values = {key: value for key, value in facts["projector"].items() if key != "kind"}
    arrays = {key: np.array(values[key], float) for key in ("rotation", "centre")}
    return PinholeProjector(**(values | arrays))


def true_depth(projector: PinholeProjector, rays: Array, s: Array) -> Array:
    """Depth (N,) mm at which rays (N, 3) with z = 1 meet the
    sheets s (N,), by the secant method."""
    near, far = np.full(len(s), 1000.0), np.full(len(s), 1500.0)
    off_near = projector.stripe(rays * near[:, None]) - s
    for _ in range(20):
        off = projector.stripe(rays * far[:, None]) - s
        with np.errstate(invalid="ignore", divide="ignore"):
            step = off * (far - near) / (off - off_near)
        near, off_near = far, off
        far = far - np.where(np.isfinite(step), step, 0.0)
    return np.where(np.abs(projector.stripe(rays * far[:, None]) - s) < 1e-6, far, np.nan)


def striped_shots(rig: Rig, workspace: Path) -> dict[str, list[str]]:
    """Shots in which each pair took stripes of a board."""
    captures = open_captures(rig, workspace / "rig.yaml")
    return {
        pair.name: [s.shot for s in captures.pair_sequences(pair.name) if s.has_stripes]
        for pair in rig.pairs
    }


def boards_reached(
    rig: Rig, facts: dict[str, Any], pair: str, shots: dict[str, list[str]], s: Array
) -> Indices:
    """Number (N,) of boards seen by the camera on which the true sheets s (N,) fell."""
    true = facts["pairs"][pair]
    camera, projector = TrueCamera(**true["camera"]), true_projector(true)
    camera_from_rig = RigidTransform.from_matrix(true["rig_from_camera"]).inverse()
    reached = np.zeros(len(s), np.int64)
    for shot in shots[pair]:
        board = facts["shots"][shot]
        pose = camera_from_rig @ RigidTransform.from_matrix(board["rig_from_board"])
        points = pose.apply(compute_corner_points(rig.board(board["board"])))
        u, v = camera.image(points).T
        seen = (u > 0) & (u < camera.width - 1) & (v > 0) & (v < camera.height - 1)
        on = projector.stripe(points[seen])
        if np.isfinite(on).any():
            reached += (s >= np.nanmin(on)) & (s <= np.nanmax(on))
    return reached


class Body:
    """The true surface, ready for queries."""

    def __init__(self, vertices: Array, faces: Indices) -> None:
        self._centre = vertices.mean(axis=0)
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=2)
        self._scene.add_triangles(
            o3d.core.Tensor((vertices - self._centre).astype(np.float32)),
            o3d.core.Tensor(faces.astype(np.uint32)),
        )

    def struck(self, body_from_camera: RigidTransform, points: Array) -> Mask:
        """Whether the ray of a point (N, 3), camera frame, meets the body near that point, (N,)."""
        start = body_from_camera.translation - self._centre
        ways = body_from_camera.rotate(points)
        rays = np.hstack([np.broadcast_to(start, ways.shape), ways]).astype(np.float32)
        share = self._scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        return np.asarray(np.abs(share - 1.0) * np.linalg.norm(points, axis=1) < ON_BODY_MM)

    def distances(self, points: Array) -> tuple[Array, Array]:
        """Signed distances (N,) mm from the plane of the nearest face, outside positive, and
        normals (N, 3)."""
        centred = points - self._centre
        found = self._scene.compute_closest_points(o3d.core.Tensor(centred.astype(np.float32)))
        normals = found["primitive_normals"].numpy().astype(float)
        return np.sum((centred - found["points"].numpy()) * normals, axis=1), normals

    def aligned(self, points: Array) -> Array:
        """Points moved rigidly onto the surface: point to plane, without outliers."""
        for _ in range(ROUNDS):
            off, normals = self.distances(points)
            near = np.abs(off) < OUTLIER * max(float(np.median(np.abs(off))), 1e-6)
            middle = points.mean(axis=0)
            jacobian = np.hstack([np.cross(points - middle, normals), normals])[near]
            step = -np.linalg.lstsq(jacobian, off[near], rcond=None)[0]
            turn = RigidTransform.from_rotation_vector(step[:3], middle + step[3:])
            points = turn.apply(points - middle)
        return points
