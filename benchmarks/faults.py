"""Faults put into captures of two subjects on both rigs: the verdicts, and the cost of the faults.

At half size, the people alone: their rigs are calibrated by `calibration_from_truth`. Renderings
are kept in bench/faults, 2 minutes each on two idle cores; a fault takes some 10 s, one core per
column. python -m benchmarks.faults RIG SUBJECT [WORDS] prints one column, for faults whose names
hold WORDS.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d

from benchmarks.fault_injection import Case, Fault, Sound, faults, faults_of_the_living
from benchmarks.full_size import PROJECT, run_commands
from benchmarks.true_calibration import calibration_from_truth
from bodyscan.captures.folder import open_scan
from bodyscan.errors import BodyscanError
from bodyscan.evaluation.body import compute_girth_errors, measure_true_girths
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.progress import THREADS
from bodyscan.settings import FusionSettings, MeshSettings, ScanSettings
from bodyscan.workflows.range_images import reconstruct_range_images
from bodyscan.workflows.scan_person import fuse

FOLDER = PROJECT / "bench" / "faults"
RIGS = ("three-pole-12", "four-pole-16")
SUBJECTS = ("woman_average", "man_average")
KINDS = {
    "mannequin": ["--subject-preset", "mannequin"],
    "standing": ["--subject-preset", "standing"],
    "ideal": ["--subject-preset", "mannequin", "--preset", "ideal"],
}
"""How a subject is rendered: with workshop devices, except for `ideal`."""
CRASHED = "crashed"
IDEAL, LIVING = "ideal devices", "a living person"
SWAY_MM, SWAYS = 5.0, 3
SETTINGS = ScanSettings(
    fusion=FusionSettings(points=250_000), mesh=MeshSettings(depth=8, reach_mm=8.0)
)
"""Half-size images: half as many points along each axis, and cells of twice the size."""


@dataclass(frozen=True)
class Found:
    """How one fault was judged.

    girth_mm: the worst error of a trunk girth reported as measured; None if there is none.
    named: whether the verdict names the fault.
    """

    rig: str
    subject: str
    fault: str
    grade: str
    girth_mm: float | None
    named: bool
    said: str


def report() -> str:
    """The section of docs/results.md."""
    found: list[Found] = []
    columns = [(rig, subject) for rig in RIGS for subject in SUBJECTS]
    for column in columns:
        _simulate(*column)
    with ProcessPoolExecutor(THREADS, multiprocessing.get_context("spawn")) as pool:
        for judged in pool.map(_of, *zip(*columns, strict=True)):
            found += judged
    return _told(found, columns)


def _workspace(rig: str, subject: str, kind: str) -> Path:
    return FOLDER / f"{rig}-{subject}-{kind}"


def _simulate(rig: str, subject: str) -> None:
    """Simulate at half size; also the other subject, which some faults mix in. A mirror's smile is
    left out, because `calibration_from_truth` has true planes."""
    other = next(name for name in SUBJECTS if name != subject)
    for who, kind in (*((subject, kind) for kind in KINDS), (other, "mannequin")):
        workspace = _workspace(rig, who, kind)
        made: list[object] = [PROJECT / "rigs" / f"{rig}.yaml", "--out", workspace]
        made += ["--scale", 0.5, "--subject", PROJECT / "data" / "subjects" / f"{who}.ply"]
        made += [*KINDS[kind], "--board-shots", 0, "--set", "projection.smile_stripes=0"]
        run_commands({"simulate": made}, workspace)


def _of(rig: str, subject: str) -> list[Found]:
    return [
        _judge(rig, subject, fault, sound)
        for kind, listed in _listed().items()
        for sound in [_sound(rig, subject, kind)]
        for fault in listed
    ]


def _listed() -> dict[str, list[Fault]]:
    """Faults by the kind of captures they are put into, sound scans first."""
    ideal = [replace(fault, name=f"{fault.name}, {IDEAL}") for fault in _nothing()[:2]]
    return {"mannequin": [*_nothing(), *faults()], "standing": [*_living()], "ideal": ideal}


def _living() -> Iterator[Fault]:
    yield replace(_nothing()[0], name=f"none, {LIVING}")
    for fault in faults_of_the_living():
        yield replace(fault, name=f"{fault.name}, {LIVING}")


def _sound(rig: str, subject: str, kind: str) -> Sound:
    workspace = _workspace(rig, subject, kind)
    calibration = calibration_from_truth(workspace)
    person = workspace / "captures" / "person"
    other = next(name for name in SUBJECTS if name != subject)
    stranger = _workspace(rig, other, "mannequin")
    images, others = (
        reconstruct_range_images(calibration, open_scan(calibration.rig, folder)).value
        for folder in (person, stranger / "captures" / "person")
    )
    truth = o3d.io.read_triangle_mesh(str(workspace / "truth" / "subject.ply"))
    vertices, faces = np.asarray(truth.vertices), np.asarray(truth.triangles).astype(np.int64)
    girths = measure_true_girths(vertices, faces)
    return Sound(calibration, images, others, person, vertices, faces, girths)


def _told(found: Sequence[Found], columns: Sequence[tuple[str, str]]) -> str:
    names = list(dict.fromkeys(one.fault for one in found))
    cells = {(one.fault, one.rig, one.subject): _cell(one) for one in found}
    rows = [
        f"| {name} | " + " | ".join(cells.get((name, *column), "") for column in columns) + " |"
        for name in names
    ]
    sound = [one for one in found if one.fault.startswith("none")]
    wrong = [one for one in found if not one.fault.startswith("none")]
    costly = [one for one in wrong if _costs(one, 4.0) and one.grade in ("good", "usable")]
    passed = [one for one in wrong if _costs(one, 2.0) and one.grade == "good"]
    told = [one for one in wrong if one.grade != "good"]
    heads = " | ".join(f"{rig}, {subject.split('_')[0]}" for rig, subject in columns)
    share = sum(one.named for one in told) / max(len(told), 1)
    goals = [
        ("cost more than 4 mm of girth, graded good or usable", "0", len(costly)),
        ("cost more than 2 mm, graded good", "0", len(passed)),
        (f"sound scans ({len(sound)}) to be repeated", "0", sum(map(_refused, sound))),
        (
            f"sound scans ({len(sound)}) less than good",
            "2",
            sum(one.grade != "good" for one in sound),
        ),
        ("end in a traceback", "0", sum(one.grade == CRASHED for one in found)),
        (f"faults told ({len(told)}) whose cause is named", "80 %", f"{100.0 * share:.0f} %"),
    ]
    targets = "\n".join(f"| {what} | {target} | {number} |" for what, target, number in goals)
    return f"""## Faults, and what becomes of them (synthetic)

{len(wrong)} faults and {len(sound)} sound scans, of half-size captures by workshop devices where none
are said (`python -m benchmarks faults`): the verdict, and the worst error in mm of a tape girth of the
trunk that is given as measured (- where none is). A star: the verdict does not name the cause.

| | target | found |
|---|---|---|
{targets}

| fault | {heads} |
|---|{"---|" * len(columns)}
{chr(10).join(rows)}
"""


def _refused(one: Found) -> bool:
    return one.grade in ("repeat", "refused", CRASHED)


def _cell(one: Found) -> str:
    error = "-" if one.girth_mm is None else f"{one.girth_mm:.1f}"
    star = "" if one.named or one.grade == "good" or one.fault.startswith("none") else " *"
    return f"{one.grade} {error}{star}"


def _costs(one: Found, mm: float) -> bool:
    return one.girth_mm is not None and one.girth_mm > mm


def _nothing() -> list[Fault]:
    """Sound scans: as they are, and with random sways between the pairs."""
    return [
        Fault("none", (), lambda sound: (sound.calibration, Outcome(sound.images))),
        *(Fault(f"none, {SWAY_MM:g} mm of sway ({k})", (), _swaying(k)) for k in range(SWAYS)),
    ]


def _swaying(seed: int) -> Callable[[Sound], Case]:
    """Sway as of a person on two feet while the pairs fire in turn: `SWAY_MM` at the head."""

    def inject(sound: Sound) -> Case:
        rng = np.random.default_rng(seed)
        placed = sound.calibration.rig_from_camera
        moment = np.linspace(0.0, 1.0, len(placed))[:, None]
        path = np.zeros((len(placed), 2))
        for waves in (0.5, 1.0, 1.5):
            phase = 2.0 * np.pi * waves * moment + rng.uniform(0.0, 2.0 * np.pi, 2)
            size = rng.standard_normal(2) / waves
            path += size * np.sin(phase)
        path -= path[0]
        to_lean = SWAY_MM / np.linalg.norm(path, axis=1).max() / float(sound.vertices[:, 2].max())
        leans = to_lean * np.stack([-path[:, 1], path[:, 0], np.zeros(len(path))], axis=1)
        moved = {
            name: RigidTransform.from_rotation_vector(lean, np.zeros(3)) @ at
            for (name, at), lean in zip(placed.items(), leans, strict=True)
        }
        calibration = replace(sound.calibration, rig_from_camera=moved)
        return calibration, Outcome(sound.images)

    return inject


def _judge(rig: str, subject: str, fault: Fault, sound: Sound) -> Found:
    try:
        calibration, measured = fault.inject(sound)
        scan = fuse(calibration, measured, SETTINGS)
    except BodyscanError as error:
        return Found(rig, subject, fault.name, "refused", None, True, str(error))
    except Exception as error:  # costs its cell, not the hours of the others
        return Found(rig, subject, fault.name, CRASHED, None, False, repr(error))
    try:
        errors = compute_girth_errors(scan.mesh, sound.girths)
        worst = errors.worst_mm if np.isfinite(errors.worst_mm) else None
    except BodyscanError:  # a body cut short gives no girth
        worst = None
    said = " | ".join(scan.verdict.reasons)
    named = any(word in said for word in fault.named)
    return Found(rig, subject, fault.name, scan.verdict.grade, worst, named, said)


if __name__ == "__main__":
    chosen = (sys.argv[1], sys.argv[2])
    _simulate(*chosen)
    judged: list[Found] = []
    for kind, listed in _listed().items():
        asked = [fault for fault in listed if " ".join(sys.argv[3:]) in fault.name]
        own = _sound(*chosen, kind) if asked else None
        for fault in asked:
            assert own is not None
            one = _judge(*chosen, fault, own)
            judged.append(one)
            print(f"{one.fault}: {_cell(one)}\n    {one.said}", flush=True)
    print(_told(judged, [chosen]))
