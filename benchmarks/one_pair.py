"""What one pair makes of a person who moves while it looks: plain, and carried to one moment.

Synthetic, at full size, the woman in the rig of `three-pole`, calibrated there. Renderings are kept in
bench/one-pair: a minute and a half each on idle cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import open3d as o3d

from benchmarks.full_size import PROJECT, WORKSPACE, run_commands
from bodyscan.arrays import Array, Indices
from bodyscan.captures.folder import ImageSequence, open_scan
from bodyscan.evaluation.comparison import fit_to_surface
from bodyscan.fusion.cleaning import clean
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.scene import centred_scene
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.triangulation import reconstruct_range_image
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import load_calibration
from bodyscan.simulation.living import LivingBody, body_of
from bodyscan.workflows.decode import decode_sequence
from bodyscan.workflows.range_images import reconstruct_sequence

FOLDER = PROJECT / "bench" / "one-pair"
MOTIONS = {
    "sways by a hundredth of that": ("mannequin", 0.075),
    "sways, 7.5 mm/s at the head": ("mannequin", 7.5),
    "and breathes, moves arms and head": ("standing", 7.5),
}
"""Subject's preset, and its sway, mm/s."""
NEAR_MM = 5.0
"""A depth that is off by more is of another surface: the truth's ray passes a rim."""


def report() -> str:
    """The section of docs/results.md."""
    rows = [
        row for name, motion in MOTIONS.items() for row in _rows(name, _rendered(name, *motion))
    ]
    return f"""## One pair and a person who moves (synthetic)

The woman in the rig of `three-pole-12`, calibrated there, workshop devices; twelve pairs one after
the other, each cleaned and judged by itself. Depths against the true body at the middle of the
pair's images, in mm: as they are, and after the rigid motion that fits them best; the mean square
over all pairs, median and worst pair. Plain: stripes decoded as if nothing moved. Carried: as
`scan` does it, by what the stripes tell of the motion.

| subject | decoded | RMS; median, worst pair | after its rigid motion: RMS; median, worst pair |
|---|---|---|---|
{chr(10).join(rows)}
"""


def _rendered(name: str, preset: str, sway_mm_s: float) -> Path:
    folder = FOLDER / str(list(MOTIONS).index(name))
    made: list[object] = [PROJECT / "rigs" / "three-pole-12.yaml", "--out", folder]
    made += ["--subject", PROJECT / "data" / "subjects" / "woman_average.ply"]
    made += ["--subject-preset", preset, "--set", f"person.sway_mm_s={sway_mm_s}"]
    run_commands({"simulate": [*made, "--board-shots", 0]}, folder)
    return folder


def _rows(name: str, folder: Path) -> list[str]:
    calibration = load_calibration(WORKSPACE / "calibration")
    captures = open_scan(calibration.rig, folder / "captures" / "person")
    body = body_of(folder / "truth")
    assert body
    carried = [reconstruct_sequence(calibration, captures, one)[0] for one in captures.sequences]
    plain = [_plain(calibration, one) for one in captures.sequences]
    at = {image.pair: image.time_ms for image in carried}
    rows = []
    for decoded, images in (("plain", plain), ("carried", carried)):
        kept = clean(images, calibration.rig_from_camera, calibration.rig.volume)
        errors = [_errors(calibration, image, body, at[image.pair] or 0.0) for image in kept]
        rows.append(_row(name, decoded, errors))
    return rows


def _plain(calibration: RigCalibration, sequence: ImageSequence) -> RangeImage:
    stripes = decode_sequence(sequence, calibration.rig.pair(sequence.pair))
    return reconstruct_range_image(calibration.pairs[sequence.pair], stripes)


def _errors(
    calibration: RigCalibration, image: RangeImage, body: LivingBody, ms: float
) -> tuple[float, float]:
    """RMS errors of depth, mm: as they are, and after the rigid motion that fits them best."""
    vertices, faces = body.vertices(ms), np.asarray(body.rest.triangles, np.int64)
    there = calibration.rig_from_camera[image.pair]
    points = there.apply(image.points[image.valid].astype(float))
    fitted = fit_to_surface(points, vertices, faces)
    motions = (RigidTransform.identity(), fitted)
    plain, fine = (
        rms(_depth_errors(motion.apply(points), motion.apply(there.translation), vertices, faces))
        for motion in motions
    )
    return plain, fine


def _depth_errors(points: Array, eye: Array, vertices: Array, faces: Indices) -> Array:
    """Of points (N, 3) along the rays on which `eye` (3,) sees them, mm; too far is dropped."""
    scene, centre = centred_scene(vertices, faces)
    ways = points - eye
    far = np.linalg.norm(ways, axis=1)
    rays = np.column_stack([np.broadcast_to(eye - centre, ways.shape), ways / far[:, None]])
    hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
    errors = far - hit
    return np.asarray(errors[np.abs(errors) < NEAR_MM], np.float64)


def _row(name: str, decoded: str, pairs: Sequence[tuple[float, float]]) -> str:
    each = [f"{rms(one):.3f}; {np.median(one):.3f}, {one.max():.3f}" for one in np.array(pairs).T]
    return f"| {name} | {decoded} | {' | '.join(each)} |"
