"""From range images to cloud and mesh: our method and two others on the same range images, in one
run.

Each step runs in a process of its own, so that peak memory is measured per step:
python -m benchmarks.fusion STEP WORKSPACE FOLDER
"""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import full_size
from bodyscan.arrays import Array, Indices
from bodyscan.memory import keep_freed_memory
from bodyscan.mesh.body import BodyCloud
from bodyscan.settings import ScanSettings

Figures = dict[str, Any]
SETTINGS = ScanSettings()
ICP_VOXEL_MM, ICP_REACH_MM = 3.0, 6.0
MEASURED_MM = 4.0  # a vertex nearer than this to a point of the cloud was measured
VOXELS, DEPTHS = (1.0, 1.5, 2.0), (8, 9, 10)
"""Settings tried for rivals: voxel sizes as multiples of the one that gives as many points as ours,
and depths of Poisson's octree. The best of each, compared with the truth, is shown."""
OURS, RUNS = ("read", "ours", "mesh"), 5
MULTIWAY, BY_OPEN3D = "open3d-multiway", "ours-by-open3d"
NAMES = {
    "opencv": "OpenCV: reading and decompressing the PNGs",
    "read": "bodyscan: reading and decompressing the PNGs",
    "ours": "bodyscan: PNGs to the cloud",
    "mesh": "bodyscan: mesh",
    BY_OPEN3D: "bodyscan: `--align open3d` and merging",
    MULTIWAY: "Open3D: multiway ICP, then voxels",
    "open3d-voxels": "Open3D: voxels, no ICP",
    "open3d-poisson": "Open3D: Poisson of these voxels",
    "pymeshlab-poisson": "pymeshlab: screened Poisson of these voxels",
}
FAMILIES: dict[str, tuple[str, ...]] = {
    "open3d-voxels": tuple(f"open3d-voxels-{size:g}" for size in VOXELS),
    "open3d-poisson": tuple(f"open3d-poisson-{depth}" for depth in DEPTHS),
    "pymeshlab-poisson": tuple(f"pymeshlab-poisson-{depth}" for depth in DEPTHS[:2]),
}
STEPS = (*OURS, BY_OPEN3D, MULTIWAY, *(step for steps in FAMILIES.values() for step in steps))


def report(workspace: Path | None = None) -> str:
    """The section of docs/results.md; the workspace is `full_size`, simulated and calibrated."""
    workspace = workspace or Path(os.environ.get("BODYSCAN_BENCH", full_size.WORKSPACE))
    with tempfile.TemporaryDirectory() as folder:
        found = {step: _in_a_process(step, workspace, Path(folder)) for step in STEPS}
    shown = {"opencv": (found["ours"]["opencv"], "")}
    shown |= {step: (found[step], "") for step in (*OURS, BY_OPEN3D, MULTIWAY)}
    shown |= {family: _best(found, steps) for family, steps in FAMILIES.items()}
    rows = "\n".join(_row(step, *best) for step, best in shown.items() if best[0])
    skipped = (
        "" if found["pymeshlab-poisson-9"] else "\npymeshlab was not installed and was left out.\n"
    )
    stages = ", ".join(f"{name} {s:.1f}" for name, s in found["ours"]["stages"].items())
    firsts = ", ".join(f"{found[step]['first']:.1f}" for step in OURS)
    opencv = found["ours"]["opencv"]
    ratio = found["ours"]["seconds"] / opencv["seconds"]
    processor = found["ours"]["cpu"] / opencv["cpu"]
    return f"""## Range images to cloud and mesh, against others, in one run

The scan of `{workspace.name}` (12 pairs, 22 images each); all others get our cleaned range images,
placed by our calibration, and of several settings (voxels {VOXELS} times as large as give as
many points as ours; octrees of depth {DEPTHS}) the one that is best against the truth is shown.
Multiway ICP is what Open3D's tutorial does, without the boards; it moves what was placed well.
Seconds of wall clock and of processor, peak memory; distances to the truth in mm (nothing aligned to
it): of all points of a cloud; of a mesh's vertices, whoever made it, within {MEASURED_MM:g} mm of a
point of the cloud that it was made of. Times of Open3D and pymeshlab begin at the range images.
Our three steps: the fastest of {RUNS} runs in one warm process, which is not what a user waits for
(that is under "Seconds"); the first, which also loads the compiled code, took {firsts} s. OpenCV's
reading: the fastest of {RUNS}, in turn with ours to the cloud, in that process, so that both see the
same machine.

| | s | cpu s | GiB | bias | RMS | 95 % | worst |
|---|---|---|---|---|---|---|---|
{rows}
{skipped}
From PNGs to the cloud takes {ratio:.2f} times as long as OpenCV takes to read the PNGs with as many
threads ({processor:.2f} times the processor time). Stages, s: {stages}.
Pairs to each other (overlaps, RMS): {found["ours"]["overlap_mm"]:.3f} mm.
{_versions_line(found["mesh"])}
"""


def _best(found: dict[str, Figures], steps: tuple[str, ...]) -> tuple[Figures, str]:
    """The step whose result is nearest to the truth, and its setting."""
    ran = [step for step in steps if found[step]]
    if not ran:
        return {}, ""
    step = min(ran, key=lambda one: found[one]["deviation"]["rms_mm"])
    return found[step], f" ({step.rsplit('-', 1)[1]})"


def _row(step: str, figures: Figures, setting: str) -> str:
    measured = figures.get("deviation")
    distances = (
        [f"{measured[key]:{sign}.3f}" for key, sign in _COLUMNS.items()] if measured else [""] * 4
    )
    cells = [NAMES[step] + setting, f"{figures['seconds']:.1f}", f"{figures['cpu']:.1f}"]
    return "| " + " | ".join([*cells, f"{figures['gib']:.1f}", *distances]) + " |"


_COLUMNS = {"bias_mm": "+", "rms_mm": "", "p95_mm": "", "worst_mm": ""}


def _in_a_process(step: str, workspace: Path, folder: Path) -> Figures:
    if step.startswith("pymeshlab") and importlib.util.find_spec("pymeshlab") is None:
        return {}
    line = [sys.executable, "-m", "benchmarks.fusion", step, str(workspace), str(folder)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{step} failed:\n{done.stdout}\n{done.stderr}")
    figures: Figures = json.loads(done.stdout.splitlines()[-1])
    return figures


def main(step: str, workspace: Path, folder: Path) -> None:
    """Run one step; the last line printed is its figures as JSON."""
    work, finish = _STEPS[step](workspace, folder)
    result, times, yardstick = None, [], []
    paths = _images_of(workspace) if step == "ours" else []
    for _ in range(RUNS if step in OURS else 1):
        result = None  # frees the last run's memory for this one
        if step == "ours":
            yardstick.append(_timed(lambda: _read_with_opencv(paths))[0])
        seconds, result = _timed(work)
        times.append(seconds)
    gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    figures: Figures = {"first": times[0][0], "gib": gib, **_fastest(times)}
    if yardstick:
        figures["opencv"] = {"gib": gib, **_fastest(yardstick)}
    print(json.dumps(figures | finish(result)))


def _timed(work: Callable[[], Any]) -> tuple[tuple[float, float], Any]:
    """Wall-clock and processor seconds, and the result."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return (time.perf_counter() - wall, time.process_time() - cpu), result


def _fastest(times: list[tuple[float, float]]) -> Figures:
    return {"seconds": min(times)[0], "cpu": min(times)[1]}


Step = tuple[Callable[[], Any], Callable[[Any], Figures]]


def _read(workspace: Path, folder: Path) -> Step:
    from bodyscan.captures.images import read_sequence
    from bodyscan.progress import map_threads

    calibration, captures = _scan_of(workspace)
    cameras = {pair.name: pair.camera for pair in calibration.rig.pairs}

    def read(sequence: Any) -> None:
        read_sequence(sequence, cameras[sequence.pair], workers=1)

    return lambda: map_threads(read, captures.sequences), lambda _: {}


def _images_of(workspace: Path) -> list[list[str]]:
    """The image files of every pair."""
    sequences = _scan_of(workspace)[1].sequences
    return [[str(s.lit), *([str(s.dark)] if s.dark else []), *map(str, s.coded)] for s in sequences]


def _read_with_opencv(paths: list[list[str]]) -> None:
    import cv2

    from bodyscan.progress import map_threads

    def read(pair: list[str]) -> list[Any]:
        return [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in pair]

    map_threads(read, paths)


def _ours(workspace: Path, folder: Path) -> Step:
    from bodyscan.alignment.icp import align
    from bodyscan.fusion.cleaning import clean
    from bodyscan.fusion.merging import merge
    from bodyscan.fusion.pose_variance import add_pose_variance
    from bodyscan.workflows.range_images import reconstruct_range_images

    calibration, captures = _scan_of(workspace)
    stages: dict[str, float] = {}

    def stage(name: str, work: Callable[[], Any]) -> Any:
        started = time.perf_counter()
        result = work()
        stages[name] = time.perf_counter() - started
        return result

    def work() -> Any:
        images = stage(
            "range images", lambda: reconstruct_range_images(calibration, captures)
        ).value
        placed = calibration.rig_from_camera
        cleaned = stage("cleaning", lambda: clean(images, placed, calibration.rig.volume))
        seen = [image for image in cleaned if image.valid.any()]
        alignment = stage(
            "aligning", lambda: align(seen, placed, calibration.covariance, SETTINGS.alignment)
        )
        placing = {**placed, **alignment.rig_from_camera}
        cloud = stage("merging", lambda: merge(seen, placing, SETTINGS.fusion).cloud)
        there = {image.pair: placing[image.pair] for image in seen}
        cloud = stage("error bars", lambda: add_pose_variance(cloud, there, calibration.covariance))
        return images, seen, placed, placing, cloud, alignment

    def finish(result: Any) -> Figures:
        images, seen, placed, placing, cloud, alignment = result
        _keep(folder / "ours", (images, seen, placed, placing, cloud))
        return {
            "stages": stages,
            "overlap_mm": alignment.rms_after_mm,
            "deviation": _deviation(workspace, cloud.points),
        }

    return work, finish


def _mesh(workspace: Path, folder: Path) -> Step:
    from bodyscan.fusion.meshing import attach_attributes, make_closed_surface

    images, _, _, placing, cloud = _kept(folder / "ours")

    def finish(found: Any) -> Figures:
        return {
            **_near(workspace, cloud.points, found.vertices, found.faces),
            "filled": found.filled_share,
            **versions(found),
        }

    def make() -> Any:
        shape = make_closed_surface(cloud, SETTINGS.mesh, images, placing)
        return attach_attributes(*shape, cloud, SETTINGS.mesh.reach_mm)

    return make, finish


def versions(full: Any) -> Figures:
    """Distances between the light version and the full one, and self-intersections of each.

    Distances, mm, are those of random points on the light mesh and of all vertices of the full one.
    """
    from benchmarks.self_intersections import self_intersections
    from bodyscan.evaluation.surface import compute_signed_distances, sample_surface
    from bodyscan.mesh.repair import decimate

    lean = decimate(full)
    spots = sample_surface(lean.vertices, lean.faces, 500_000)[0]
    distances = np.abs(
        np.concatenate(
            [
                compute_signed_distances(spots, full.vertices, full.faces),
                compute_signed_distances(full.vertices, lean.vertices, lean.faces),
            ]
        )
    )
    return {
        "light_faces": len(lean.faces),
        "light_rms_mm": float(np.sqrt(np.mean(distances**2))),
        "light_p999_mm": float(np.percentile(distances, 99.9)),
        "light_worst_mm": float(distances.max()),
        "light_self_intersections": len(self_intersections(lean.vertices, lean.faces)),
        "self_intersections": len(self_intersections(full.vertices, full.faces)),
    }


def _versions_line(figures: Figures) -> str:
    return (
        f"Of our mesh {100 * figures['filled']:.1f} % is made up. The light version"
        f" ({figures['light_faces']} faces) and the full one lie {figures['light_rms_mm']:.3f} mm RMS"
        f" from each other, {figures['light_p999_mm']:.2f} at 99.9 %,"
        f" {figures['light_worst_mm']:.2f} at most. Edges that pierce a face:"
        f" {figures['self_intersections']} of the full mesh,"
        f" {figures['light_self_intersections']} of the light one."
    )


def _by_open3d(workspace: Path, folder: Path) -> Step:
    """Our range images and our merging, with Open3D's registration between them."""
    from bodyscan.alignment.icp import align
    from bodyscan.fusion.merging import merge
    from bodyscan.settings import AlignmentSettings

    _, seen, placed, _, _ = _kept(folder / "ours")
    calibration, _ = _scan_of(workspace)
    settings = AlignmentSettings(matching="open3d")

    def work() -> Any:
        found = align(seen, placed, calibration.covariance, settings)
        return merge(seen, {**placed, **found.rig_from_camera}, SETTINGS.fusion).cloud

    return work, lambda cloud: {"deviation": _deviation(workspace, cloud.points)}


def _multiway(workspace: Path, folder: Path) -> Step:
    """The method of Open3D's own tutorial: ICP of every two, pose graph, all points into voxels."""
    _, seen, placed, _, cloud = _kept(folder / "ours")
    spacing = _spacing(cloud)

    def finish(merged: Any) -> Figures:
        return {"deviation": _deviation(workspace, np.asarray(merged.points))}

    return lambda: multiway(seen, placed, spacing), finish


def _voxels(size: float) -> Callable[[Path, Path], Step]:
    """All points into voxels at the poses of our calibration; those of size 1 are kept for
    meshing."""

    def step(workspace: Path, folder: Path) -> Step:
        _, seen, placed, _, cloud = _kept(folder / "ours")
        spacing = size * _spacing(cloud)

        def finish(merged: Any) -> Figures:
            points = np.asarray(merged.points)
            if size == VOXELS[0]:
                _keep(folder / "voxels", (points, np.asarray(merged.normals)))
            return {"deviation": _deviation(workspace, points)}

        def work() -> Any:
            import open3d as o3d

            every = o3d.geometry.PointCloud()
            for one in _placed(seen, placed):
                every += one
            return every.voxel_down_sample(spacing)

        return work, finish

    return step


def _placed(seen: Any, placed: Any) -> list[Any]:
    """Range images as Open3D's clouds in the rig frame, without points that have no normal."""
    import open3d as o3d

    clouds = []
    for image in seen:
        placing, where = placed[image.pair], image.valid & np.isfinite(image.normals[..., 0])
        one = o3d.geometry.PointCloud(
            o3d.utility.Vector3dVector(placing.apply(image.points[where].astype(float)))
        )
        one.normals = o3d.utility.Vector3dVector(placing.rotate(image.normals[where].astype(float)))
        clouds.append(one)
    return clouds


def multiway(seen: Any, placed: Any, voxel_mm: float) -> Any:
    """Open3D's multiway registration of range images, started from the calibration, and merged."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    clouds = _placed(seen, placed)
    thin = [one.voxel_down_sample(ICP_VOXEL_MM) for one in clouds]
    graph = registration.PoseGraph()
    graph.nodes.extend(registration.PoseGraphNode(np.eye(4)) for _ in clouds)
    method = registration.TransformationEstimationPointToPlane()
    for i, j in combinations(range(len(thin)), 2):
        overlap = registration.evaluate_registration(thin[i], thin[j], ICP_REACH_MM)
        if overlap.fitness < 0.02:
            continue
        found = registration.registration_icp(thin[i], thin[j], ICP_REACH_MM, np.eye(4), method)
        information = registration.get_information_matrix_from_point_clouds(
            thin[i], thin[j], ICP_REACH_MM, found.transformation
        )
        edge = registration.PoseGraphEdge(i, j, found.transformation, information, uncertain=True)
        graph.edges.append(edge)
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(
            max_correspondence_distance=ICP_REACH_MM, edge_prune_threshold=0.25, reference_node=0
        ),
    )
    merged = o3d.geometry.PointCloud()
    for one, node in zip(clouds, graph.nodes, strict=True):
        merged += one.transform(node.pose)
    return merged.voxel_down_sample(voxel_mm)


def poisson(points: Array, normals: Array, depth: int) -> tuple[Array, Indices]:
    """Vertices and faces of Open3D's screened Poisson surface (Kazhdan and Hoppe 2013), in one
    thread: several would add up in a different order each time."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    surface, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=depth, n_threads=1
    )
    return np.asarray(surface.vertices), np.asarray(surface.triangles).astype(np.int64)


def _open3d_poisson(depth: int) -> Callable[[Path, Path], Step]:
    def step(workspace: Path, folder: Path) -> Step:
        points, normals = _kept(folder / "voxels")
        return lambda: poisson(points, normals, depth), lambda mesh: _near(workspace, points, *mesh)

    return step


def _pymeshlab_poisson(depth: int) -> Callable[[Path, Path], Step]:
    def step(workspace: Path, folder: Path) -> Step:
        import pymeshlab

        points, normals = _kept(folder / "voxels")

        def work() -> Any:
            meshes = pymeshlab.MeshSet()
            meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
            meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
            made = meshes.current_mesh()
            return made.vertex_matrix(), made.face_matrix()

        return work, lambda mesh: _near(workspace, points, *mesh)

    return step


_STEPS: dict[str, Callable[[Path, Path], Step]] = {
    "read": _read,
    "ours": _ours,
    "mesh": _mesh,
    BY_OPEN3D: _by_open3d,
    MULTIWAY: _multiway,
    **{f"open3d-voxels-{size:g}": _voxels(size) for size in VOXELS},
    **{f"open3d-poisson-{depth}": _open3d_poisson(depth) for depth in DEPTHS},
    **{f"pymeshlab-poisson-{depth}": _pymeshlab_poisson(depth) for depth in DEPTHS[:2]},
}


def _scan_of(workspace: Path) -> tuple[Any, Any]:
    from bodyscan.captures.folder import open_scan
    from bodyscan.registration.storage import load_calibration

    calibration = load_calibration(workspace / "calibration")
    return calibration, open_scan(calibration.rig, workspace / "captures" / "person")


def _spacing(cloud: BodyCloud) -> float:
    """Voxel size that gives about as many points as ours."""
    from bodyscan.fusion.voxel_thinning import find_voxel_size

    return find_voxel_size(cloud.points.astype(np.float32), len(cloud.points))


def _near(workspace: Path, points: Any, vertices: Any, faces: Any) -> Figures:
    from scipy.spatial import cKDTree

    near = cKDTree(points).query(vertices, distance_upper_bound=MEASURED_MM)[0] < np.inf
    return {"deviation": _deviation(workspace, np.asarray(vertices)[near])}


def _deviation(workspace: Path, points: Any) -> Figures:
    from dataclasses import asdict

    from bodyscan.evaluation.surface import compute_signed_distances, summarize_deviation
    from bodyscan.workflows.evaluate import load_truth

    truth = load_truth(workspace / "truth")
    assert truth.vertices is not None
    assert truth.faces is not None
    return asdict(
        summarize_deviation(compute_signed_distances(points, truth.vertices, truth.faces))
    )


def _keep(path: Path, things: Any) -> None:
    path.write_bytes(pickle.dumps(things))  # between two steps of one run, nowhere else


def _kept(path: Path) -> Any:
    return pickle.loads(path.read_bytes())


if __name__ == "__main__":
    keep_freed_memory()  # as the commands do
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
