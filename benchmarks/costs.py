"""How costs grow: time and memory of a scan by pairs and megapixels, and over a day in one process.

Everything is made of one rendered pair: it is calibrated, and placed around a lathed figure as
often as needed. As it sees the same from everywhere, its images are linked, not rendered again.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).parents[1]
PAIRS, MEGAPIXELS = (4, 8, 12, 16, 32), (1.0, 2.0, 5.0)
BOARD_SHOTS, SEED = 6, 5
DAY, DAY_PAIRS, DAY_MEGAPIXELS, DAY_FIGURE = 300, 4, 0.1, 0.5
"""Small scans of a figure half as large, so that a day takes minutes: what a process retains of
scans does not depend on their size."""
BATCH, WORKERS = 40, (1, 2)
"""Small scans of a batch, and how many run at once, with one thread each."""
SAMPLED = 25
"""Scans of a day over which seconds are averaged."""


def report(pairs: tuple[int, ...] = PAIRS, megapixels: tuple[float, ...] = MEGAPIXELS) -> str:
    """The section of docs/results.md."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for size in megapixels:
            one = _apart(make_pair, Path(folder) / f"{size:g}", size)
            for count in pairs:
                rig = around(one, count, Path(folder) / f"{size:g}-{count}")
                rows.append(f"| {count} | {size:g} | {_scanned(rig)} |")
    table = "\n".join(rows)
    return f"""## Costs

`bodyscan scan`, cold, of a lathed figure 1.7 m high that all pairs stand around at one height: wall
clock, processor time and the most memory that it held, once each.

| pairs | megapixels | s | s of processor | MiB |
|---|---|---|---|---|
{table}
"""


def day() -> str:
    """The section of docs/results.md on a day in one process."""
    with tempfile.TemporaryDirectory() as folder:
        one = make_pair(Path(folder) / "one", DAY_MEGAPIXELS, DAY_FIGURE)
        first, last, start_mib, end_mib = _day(around(one, DAY_PAIRS, Path(folder) / "scan"))
    return f"""## A day in one process

A day of {DAY} scans ({DAY_PAIRS} pairs of {DAY_MEGAPIXELS:g} megapixels, the figure
{DAY_FIGURE:g} times as large) in one resident process: the first {SAMPLED} after the very first took
{first:.2f} s each, the last {SAMPLED} {last:.2f} s; it held {start_mib:.0f} MiB after these first,
{end_mib:.0f} MiB at the end.
"""


def batch(scans: int = BATCH) -> str:
    """The section of docs/results.md on many scans at once."""
    rows, mb = [], [0.0, 0.0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        one = make_pair(folder / "one", DAY_MEGAPIXELS, DAY_FIGURE)
        rig = around(one, DAY_PAIRS, folder / "rig")
        for k in range(scans):
            shutil.copytree(rig / "captures" / "person", folder / "scans" / f"scan-{k:03d}")
        mb[0] = _megabytes(rig / "captures") + _megabytes(rig / "calibration")
        for workers in WORKERS:
            wall, busy = _batch(rig, folder / "scans", folder / f"out-{workers}", workers)
            mb[1] = _megabytes(folder / f"out-{workers}") / scans
            rate, share = 3600.0 * scans / wall, 1.0 - busy / (workers * wall)
            rows.append((workers, wall, busy / scans, rate, rate / workers, share))
    single = rows[0][4]
    table = "\n".join(
        f"| {workers} | {wall:.0f} | {job:.1f} | {rate:.0f} | {each / single:.0%} | {share:.1%} |"
        for workers, wall, job, rate, each, share in rows
    )
    return f"""## Many scans at once

`bodyscan batch --until scan`: {scans} scans of {DAY_PAIRS} pairs of {DAY_MEGAPIXELS:g} megapixels,
each in a process of its own with one thread. A scan reads {mb[0]:.1f} MB (images, calibration) and
writes {mb[1]:.1f} MB. Overhead is the share of the workers' time in which no job ran.

| workers | s | s of a job | scans an hour | efficiency | overhead |
|---|---|---|---|---|---|
{table}
"""


def _megabytes(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def _batch(rig: Path, scans: Path, out: Path, workers: int) -> tuple[float, float]:
    """Wall clock of a batch, and the seconds that its jobs took together."""
    line = [sys.executable, "-m", "bodyscan", "batch", str(PROJECT / "pipelines" / "fuse.yaml")]
    line += ["--scans", str(scans), "--out", str(out), "--calibration", str(rig / "calibration")]
    line += [
        "--workers",
        str(workers),
        "--set",
        "resources.threads=1",
        "--until",
        "scan",
        "--quiet",
    ]
    started = time.perf_counter()
    subprocess.run(line, cwd=PROJECT, check=False, stdout=subprocess.DEVNULL)
    wall = time.perf_counter() - started
    states = [json.loads(path.read_text("utf-8")) for path in out.glob("*/state.json")]
    if sum(state["state"] == "done" for state in states) < len(list(scans.iterdir())):
        raise SystemExit(f"{' '.join(line)} failed")
    return wall, sum(state["seconds"] for state in states)


def _apart(make: Callable[..., Path], *arguments: object) -> Path:
    """What `make` returns in a process of its own: what this one holds counts as memory of those that
    it starts."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(make, *arguments).result()


def make_pair(folder: Path, megapixels: float, figure: float = 1.0) -> Path:
    """A workspace of one pair that looks at the figure's middle, simulated and calibrated.

    figure: its size factor.
    """
    from bodyscan.rig.gauge import RigFrame
    from bodyscan.rig.rig import load_rig, write_rig
    from bodyscan.simulation import compose_settings, simulate
    from bodyscan.workflows.calibrate_rig import calibrate_folder

    rig = load_rig(PROJECT / "rigs" / "three-pole-12.yaml")
    pair = next(pair for pair in rig.pairs if pair.name == "p1-2")
    alone = rig.model_copy(update={"pairs": (pair,), "rig_frame": RigFrame(pair=pair.name)})
    folder.mkdir(parents=True)
    write_rig(folder / "one.yaml", alone)
    _write_figure(folder / "figure.ply", figure)
    scale = float(np.sqrt(1e6 * megapixels / (pair.camera.width * pair.camera.height)))
    simulate(
        folder / "one.yaml",
        folder,
        subject=folder / "figure.ply",
        scale=scale,
        seed=SEED,
        settings=compose_settings("mirror"),
        board_shots=BOARD_SHOTS,
    )
    calibrate_folder(folder / "rig.yaml", folder / "calibration")
    return folder


def _write_figure(path: Path, size: float) -> None:
    """Write a figure turned on a lathe, metres, z up, which looks the same from all around."""
    import open3d as o3d

    heights, turns = np.linspace(0.0, 1.7, 120), np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
    radii = 0.15 + 0.04 * np.cos(9.0 * heights) + 0.01 * np.cos(40.0 * heights)
    around = np.stack([np.cos(turns), np.sin(turns), np.zeros_like(turns)], axis=1)
    side = radii[:, None, None] * around + heights[:, None, None] * [0.0, 0.0, 1.0]
    ends = [[0.0, 0.0, heights[0]], [0.0, 0.0, heights[-1]]]
    ring = np.arange(len(turns))
    on = np.roll(ring, -1)
    rows = len(turns) * np.arange(len(heights) - 1)[:, None]
    bottom, top = len(heights) * len(turns), len(heights) * len(turns) + 1
    last = len(turns) * (len(heights) - 1)
    faces = [
        np.stack([rows + ring, rows + on, rows + len(turns) + on], axis=-1).reshape(-1, 3),
        np.stack([rows + ring, rows + len(turns) + on, rows + len(turns) + ring], axis=-1).reshape(
            -1, 3
        ),
        np.stack([on, ring, np.full_like(ring, bottom)], axis=-1),
        np.stack([last + ring, last + on, np.full_like(ring, top)], axis=-1),
    ]
    middle = np.array([0.0, 0.0, heights.mean()])
    vertices = middle + size * (np.concatenate([side.reshape(-1, 3), ends]) - middle)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices),
        o3d.utility.Vector3iVector(np.concatenate(faces).astype(np.int32)),
    )
    o3d.io.write_triangle_mesh(str(path), mesh)


def around(one: Path, count: int, folder: Path) -> Path:
    """A workspace in which the pair of another one stands in `count` places around the figure."""
    from bodyscan.captures.captures_file import CapturesFile, ShotEntry, write_captures_file
    from bodyscan.geometry.transforms import RigidTransform
    from bodyscan.geometry.uncertainty import PoseCovariance
    from bodyscan.registration.storage import load_calibration, save_calibration
    from bodyscan.rig.gauge import RigFrame

    known = load_calibration(one / "calibration")
    ((name, pair),) = known.pairs.items()
    names = [f"pair-{k:02d}" for k in range(count)]
    spec = known.rig.pairs[0].model_copy(update={"pole": None})
    pairs = tuple(spec.model_copy(update={"name": own}) for own in names)
    rig = known.rig.model_copy(update={"pairs": pairs, "rig_frame": RigFrame(pair=names[0])})
    turns = [
        RigidTransform.from_rotation_vector([0.0, 0.0, 2.0 * np.pi * k / count], np.zeros(3))
        for k in range(count)
    ]
    calibration = replace(
        known,
        rig=rig,
        pairs={own: replace(pair, name=own) for own in names},
        rig_from_camera={
            own: turn @ known.rig_from_camera[name] for own, turn in zip(names, turns, strict=True)
        },
        covariance=PoseCovariance(
            tuple(names), np.diag(np.tile([2e-5] * 3 + [0.05] * 3, count) ** 2)
        ),
        rig_from_board={},
        observed={},
    )
    save_calibration(calibration, folder / "calibration")
    person = folder / "captures" / "person"
    for own in names:
        place = person / "s01" / own
        place.mkdir(parents=True)
        for image in (one / "captures" / "person" / "s01" / name).iterdir():
            os.link(image, place / image.name)
    entry = ShotEntry(name="s01", stripes=tuple(names), lit=None)
    write_captures_file(person, CapturesFile(kind="scan", shots=(entry,), simulated=True))
    return folder


def _scanned(rig: Path) -> str:
    """Seconds, processor seconds and MiB of the command, as cells of a table."""
    line = [sys.executable, "-m", "bodyscan", "scan", str(rig / "captures" / "person"), "--quiet"]
    line += ["--calibration", str(rig / "calibration"), "--out", str(rig / "out"), "--overwrite"]
    started = time.perf_counter()
    process = subprocess.Popen(line, cwd=PROJECT, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - started
    if os.waitstatus_to_exitcode(status) not in (0, 1):  # 1: the verdict is to scan again
        raise SystemExit(f"{' '.join(line)} failed")
    return f"{seconds:.1f} | {used.ru_utime + used.ru_stime:.1f} | {used.ru_maxrss / 1024:.0f}"


def _day(rig: Path) -> tuple[float, float, float, float]:
    """Mean seconds of a day's first and last scans, MiB after the first scan and at the end."""
    line = [sys.executable, "-m", "benchmarks.costs", str(rig)]
    done = subprocess.run(line, capture_output=True, text=True, cwd=PROJECT, check=True)
    seconds, held = json.loads(done.stdout.splitlines()[-1])
    first = slice(1, SAMPLED + 1)
    return (
        float(np.mean(seconds[first])),
        float(np.mean(seconds[-SAMPLED:])),
        held[SAMPLED],
        held[-1],
    )


def main(rig: Path, scans: int = DAY) -> None:
    """Run a day in the resident process that `watch` keeps; prints seconds and MiB of each scan."""
    from bodyscan.settings import ScanSettings
    from bodyscan.workflows.range_images import Preparation
    from bodyscan.workflows.scan_person import scan_folder

    preparation = Preparation(rig / "calibration")
    names = [pair.name for pair in preparation.calibration.rig.pairs]
    person, seconds, held = rig / "captures" / "person", [], []
    for _ in range(scans):
        started = time.perf_counter()
        preparation.prepare(person, names)
        scan_folder(
            person, rig / "calibration", rig / "out", ScanSettings(), preparation=preparation
        )
        seconds.append(time.perf_counter() - started)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        held.append(pages * os.sysconf("SC_PAGE_SIZE") / 2**20)
    print(json.dumps([seconds, held]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
