"""What one pair makes of a person who moves while it looks: plain, and carried to one moment.

Synthetic, at full size, the woman in the rig of `three-pole`: workshop devices calibrated there, and
ideal ones whose calibration is the truth. Renderings are kept in bench/one-pair: a minute and a half
each on idle cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import open3d as o3d
from scipy.ndimage import distance_transform_edt

from benchmarks.full_size import PROJECT, WORKSPACE, run_commands
from benchmarks.true_calibration import calibration_from_facts
from bodyscan.arrays import Array, Indices
from bodyscan.captures.folder import ImageSequence, open_scan
from bodyscan.evaluation.comparison import fit_to_surface
from bodyscan.fusion.cleaning import clean
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN, rms
from bodyscan.mesh.scene import centred_scene
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.triangulation import reconstruct_range_image
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import load_calibration
from bodyscan.rig.rig_file import load_rig
from bodyscan.simulation.living import LivingBody, body_of
from bodyscan.workflows.decode import decode_sequence
from bodyscan.workflows.evaluate import load_truth
from bodyscan.workflows.range_images import reconstruct_sequence

FOLDER = PROJECT / "bench" / "one-pair"
IDEAL, WORKSHOP = "ideal", "workshop"
MOTIONS = {
    "still": ("stands still", "mannequin", 0.075),
    "sway": ("sways, 7.5 mm/s at the head", "mannequin", 7.5),
    "faster": ("sways, 15 mm/s at the head", "mannequin", 15.0),
    "breath": ("breathes, moves arms and head", "standing", 0.0),
    "living": ("sways as above, breathes, moves arms and head", "standing", 7.5),
}
"""What the subject does, its preset, and its sway, mm/s: a hundredth of a person's is still, but its
truth is told for each moment as those of the others."""
RENDERED = (
    (IDEAL, ("still", "sway", "faster", "breath")),
    (WORKSHOP, ("still", "sway", "living")),
)
NEAR_MM = 5.0
"""A depth that is off by more is of another surface: the truth's ray passes a rim."""
RIMS_PX = (0.0, 2.5, 5.0, 10.0, np.inf)
STEP_MS = 5.0


@dataclass(frozen=True, eq=False)
class _Errors:
    """Of depth, of one pair.

    plain: RMS as they are, mm.
    fitted: (N,) mm after the rigid motion that fits them best, NaN for what is of another surface.
    sigma_mm: (N,).
    rim_px: (N,) distance from where the pair measured nothing.
    """

    plain: float
    fitted: Array
    sigma_mm: Array
    rim_px: Array

    @property
    def fine(self) -> float:
        return rms(self.fitted[np.isfinite(self.fitted)])


def report() -> str:
    """The section of docs/results.md."""
    rows, places = [], []
    for devices, motions in RENDERED:
        for motion in motions:
            said = f"{devices} | {MOTIONS[motion][0]}"
            own, where = _rows(said, _rendered(devices, motion), exact=devices == IDEAL)
            rows += own
            places += [where]
    return f"""## One pair and a person who moves (synthetic)

The woman in the rig of `three-pole-12`; twelve pairs one after the other, each cleaned and judged by
itself. Workshop devices are calibrated there; the calibration of ideal ones is the truth. Depths
against the true body at the middle of the pair's images, in mm: as they are, and after the rigid
motion that fits them best; root mean square over all pairs; median and worst pair. Speed: of depth, in
mm/s, likewise. Plain: stripes decoded as if nothing moved. Carried: as `scan` does it, by what the
stripes tell of the motion.

| devices | subject | speed | decoded | RMS; median, worst | after its rigid motion |
|---|---|---|---|---|---|
{chr(10).join(rows)}

Where the error of what was carried lies: RMS of error after the rigid motion, and of its sigma, in mm,
by the distance from the nearest pixel without a depth; in brackets the share of the pixels. Errors
over sigmas: robust.

| devices | subject | up to 2.5 px | to 5 px | to 10 px | farther | over sigma |
|---|---|---|---|---|---|---|
{chr(10).join(places)}
"""


def _rendered(devices: str, motion: str) -> Path:
    _, preset, sway_mm_s = MOTIONS[motion]
    folder = FOLDER / f"{devices}-{motion}"
    made: list[object] = [PROJECT / "rigs" / "three-pole-12.yaml", "--out", folder]
    made += ["--subject", PROJECT / "data" / "subjects" / "woman_average.ply"]
    made += ["--preset", devices, "--subject-preset", preset]
    made += ["--set", f"person.sway_mm_s={sway_mm_s}", "--board-shots", 0]
    run_commands({"simulate": made}, folder)
    return folder


def _true_calibration(folder: Path) -> RigCalibration:
    rig, truth = load_rig(folder / "rig.yaml"), load_truth(folder / "truth")
    facts = truth.facts["pairs"]
    return calibration_from_facts(rig, facts, 0, shift_mm=0.0, turn_deg=0.0, planes_mm=0.0)


def _rows(said: str, folder: Path, *, exact: bool) -> tuple[list[str], str]:
    """Rows of the first table, and the row of the second."""
    calibration = (
        _true_calibration(folder) if exact else load_calibration(WORKSPACE / "calibration")
    )
    captures = open_scan(calibration.rig, folder / "captures" / "person")
    body = body_of(folder / "truth")
    assert body
    carried = [reconstruct_sequence(calibration, captures, one)[0] for one in captures.sequences]
    plain = [_plain(calibration, one) for one in captures.sequences]
    at = {image.pair: image.time_ms or 0.0 for image in carried}
    rows, errors = [], []
    for decoded, images in (("plain", plain), ("carried", carried)):
        kept = clean(images, calibration.rig_from_camera, calibration.rig.volume)
        errors = [_errors(calibration, image, body, at[image.pair]) for image in kept]
        speeds = _spread([_speed(calibration, one, body, at[one.pair]) for one in kept], 1)
        rows.append(f"| {said} | {speeds} | {decoded} | {_row(errors)} |")
    return rows, f"| {said} | {_places(errors)} |"


def _plain(calibration: RigCalibration, sequence: ImageSequence) -> RangeImage:
    stripes = decode_sequence(sequence, calibration.rig.pair(sequence.pair))
    return reconstruct_range_image(calibration.pairs[sequence.pair], stripes)


def _errors(calibration: RigCalibration, image: RangeImage, body: LivingBody, ms: float) -> _Errors:
    surface = body.vertices(ms), np.asarray(body.rest.triangles, np.int64)
    there = calibration.rig_from_camera[image.pair]
    points = there.apply(image.points[image.valid].astype(float))
    fitted = fit_to_surface(points, *surface)
    plain = _depth_errors(points, there.translation, *surface)
    fine = _depth_errors(fitted.apply(points), fitted.apply(there.translation), *surface)
    rim = distance_transform_edt(np.pad(image.valid, 1))[1:-1, 1:-1]
    return _Errors(
        rms(plain[np.isfinite(plain)]),
        fine,
        image.sigma_mm[image.valid].astype(float),
        rim[image.valid],
    )


def _speed(calibration: RigCalibration, image: RangeImage, body: LivingBody, ms: float) -> float:
    """RMS over the pixels, mm/s in depth."""
    there = calibration.rig_from_camera[image.pair]
    faces = np.asarray(body.rest.triangles, np.int64)
    points = there.apply(image.points[image.valid].astype(float))
    earlier, later = (
        _depth_errors(points, there.translation, body.vertices(ms + step), faces)
        for step in (-STEP_MS, STEP_MS)
    )
    speeds = (earlier - later) / (2e-3 * STEP_MS)
    return rms(speeds[np.isfinite(speeds)])


def _depth_errors(points: Array, eye: Array, vertices: Array, faces: Indices) -> Array:
    """Of points (N, 3) along the rays on which `eye` (3,) sees them, mm; NaN if too far."""
    scene, centre = centred_scene(vertices, faces)
    ways = points - eye
    far = np.linalg.norm(ways, axis=1)
    rays = np.column_stack([np.broadcast_to(eye - centre, ways.shape), ways / far[:, None]])
    hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
    errors = far - hit
    return np.where(np.abs(errors) < NEAR_MM, errors, np.nan)


def _row(pairs: Sequence[_Errors]) -> str:
    return f"{_spread([one.plain for one in pairs])} | {_spread([one.fine for one in pairs])}"


def _spread(pairs: Sequence[float], digits: int = 3) -> str:
    """Root mean square; median, worst."""
    values = np.array(pairs)
    each = (rms(values), float(np.median(values)), float(values.max()))
    whole, middle, worst = (f"{value:.{digits}f}" for value in each)
    return f"{whole}; {middle}, {worst}"


def _places(pairs: Sequence[_Errors]) -> str:
    error, sigma, rim = (
        np.concatenate([getattr(one, name) for one in pairs])
        for name in ("fitted", "sigma_mm", "rim_px")
    )
    seen = np.isfinite(error)
    error, sigma, rim = error[seen], sigma[seen], rim[seen]
    cells = []
    for least, most in pairwise(RIMS_PX):
        own = (rim > least) & (rim <= most)
        cells.append(f"{rms(error[own]):.3f}, {rms(sigma[own]):.3f} ({np.mean(own):.1%})")
    over = SIGMAS_PER_MEDIAN * float(np.median(np.abs(error / sigma)))
    return " | ".join([*cells, f"{over:.2f}"])
