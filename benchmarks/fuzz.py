"""Damaged files of every kind that is read: only the program's own errors may be raised.

python -m benchmarks.fuzz [COUNT] [SEED] tries COUNT files, each kind in turn; any other error is
printed once.
"""

from __future__ import annotations

import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import cv2
import numpy as np

from bodyscan.captures.captures_file import load_captures_file
from bodyscan.captures.grey_png import find_png_damage
from bodyscan.captures.image_header import NotAnImage, read_header
from bodyscan.errors import BodyscanError
from bodyscan.evaluation.acceptance import load_acceptance
from bodyscan.files.corners_vnl import read_corners
from bodyscan.fusion.storage import load_scan
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.rig_format import RIG_FORMATS
from bodyscan.jobs.pipeline import load_pipeline
from bodyscan.mesh.ply import read_ply_cloud, read_ply_mesh
from bodyscan.registration.storage import load_calibration
from bodyscan.rig.rig import load_rig

PROJECT = Path(__file__).parents[1]
STORED = PROJECT / "tests" / "data" / "stored-0.1.0"
COUNT = 100_000
LONGEST_S = 20
"""A file that takes longer would hang its reader."""
EXPECTED = (BodyscanError, NotAnImage)
WORDS = (
    b"", b"- ", b": ", b"{", b"[", b"]", b"}", b"&a ", b"*a", b"<<: *a", b"null", b"-1", b"0",
    b".nan", b"NaN", b"1e999", b"99999999999999999999", b"\n  ", b"\n", b"\t", b"'", b'"', b"true",
    b"\xff\xfe", b"\x00", b"\xf0\x9f\x98\x80", b"property list uchar int x\n", b"[[[[[[[[",
    b"!!python/object:os.system ",
)  # fmt: skip
CAPTURES = b"""version: 1
kind: scan
when: 2026-11-22T10:00:00
subject: s-17
shots:
- name: s01
  stripes: [p1-1, p1-2]
timing: {frame_ms: 8.3, start: one-after-another}
"""
CORNERS = b"# filename x y level\na/b.png 10.5 20.25 0\na/b.png 30.5 20.5 0\nb.png - - -\n"


def report() -> str:
    """The section of docs/results.md."""
    started = time.perf_counter()
    found = fuzz(COUNT)
    with tempfile.TemporaryDirectory() as there:
        kinds = sorted({kind.name for kind in _kinds(Path(there))})
    rows = "\n".join(f"- {what}: {times}" for what, times in found.items())
    return f"""## Damaged files

Every kind of file that is read, with a few bytes exchanged, cut, repeated or of one bit changed
(`python -m benchmarks.fuzz`): {", ".join(kinds)}. Nothing but the program's own errors may come out.

| | target | found |
|---|---|---|
| damaged files read | {COUNT:,} | {COUNT:,} |
| other errors, or more than {LONGEST_S} s | 0 | {sum(found.values())} |
| seconds in all | | {time.perf_counter() - started:.0f} |

{rows}
""".rstrip()


@dataclass(frozen=True)
class Kind:
    """A kind of file: one of them, in a folder with everything it needs, and its reader."""

    name: str
    file: str
    read: Callable[[Path], object]


def fuzz(count: int, seed: int = 0) -> Counter[str]:
    """Unexpected errors in `count` files, and how often each occurred."""
    found: Counter[str] = Counter()
    rng = np.random.default_rng(seed)
    signal.signal(signal.SIGALRM, _too_long)
    with tempfile.TemporaryDirectory() as there:
        sound = Path(there)
        kinds = list(_kinds(sound))
        for kind in kinds:
            kind.read(sound / kind.file)
        for number in range(count):
            kind = kinds[number % len(kinds)]
            path = sound / kind.file
            whole = path.read_bytes()
            path.write_bytes(damaged(whole, rng))
            try:
                signal.alarm(LONGEST_S)
                kind.read(path)
            except EXPECTED:
                pass
            except Exception as error:
                at = traceback.extract_tb(error.__traceback__)[-1]
                what = f"{kind.name}: {type(error).__name__}: {error} ({at.filename}:{at.lineno})"
                if not found[what]:
                    print(what, f"(seed {seed}, number {number})", flush=True)
                    traceback.print_exc()
                found[what] += 1
            finally:
                signal.alarm(0)
                path.write_bytes(whole)
    return found


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """With a few places exchanged, cut, repeated, or with one bit changed; mostly near the start,
    where headers are."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 5)):
        size = len(data)
        start = int(size * rng.random() ** rng.choice([1, 4])) if size else 0
        way = rng.integers(6)
        if way == 0:
            data[start : start + int(rng.integers(0, 12))] = rng.bytes(int(rng.integers(0, 12)))
        elif way == 1:
            data[start : start + int(rng.integers(0, 12))] = WORDS[rng.integers(len(WORDS))]
        elif way == 2 and start < size:
            data[start] ^= 1 << int(rng.integers(8))
        elif way == 3:
            del data[start : start + int(rng.integers(200) if rng.random() < 0.7 else size)]
        elif way == 4:
            part = data[start : start + int(rng.integers(1, 60))]
            data[start:start] = part * int(rng.integers(1, 4))
        else:
            other = int(rng.integers(0, size + 1))
            data[start : start + 8] = data[other : other + 8]
    return bytes(data)


def _kinds(folder: Path) -> Iterator[Kind]:
    for number, source in enumerate(sorted((PROJECT / "rigs").glob("*.yaml"))):
        shutil.copy(source, folder / f"rig{number}.yaml")
        yield Kind("rig file", f"rig{number}.yaml", load_rig)
    rig = load_rig(PROJECT / "rigs" / "three-pole-12.yaml")
    (folder / "captures.yaml").write_bytes(CAPTURES)
    yield Kind("captures.yaml", "captures.yaml", lambda path: load_captures_file(path.parent, rig))
    shutil.copy(PROJECT / "pipelines" / "full.yaml", folder / "pipeline.yaml")
    yield Kind("pipeline", "pipeline.yaml", load_pipeline)
    (folder / "accept.yaml").write_text("version: 1\nlimits: {flatness_mm: 0.5}\n", "utf-8")
    yield Kind("acceptance", "accept.yaml", load_acceptance)
    (folder / "corners.vnl").write_bytes(CORNERS)
    yield Kind("corners", "corners.vnl", read_corners)
    yield from _images(folder)
    shutil.copytree(STORED, folder / "stored")
    for name in ("calibration.json", "calibration.npz"):
        yield Kind(
            name,
            f"stored/calibration/{name}",
            lambda path: load_calibration(path.parent, accept_changed=True),
        )
    yield Kind("scan.json", "stored/scan/scan.json", lambda path: load_scan(path.parent))
    yield Kind("cloud", "stored/scan/cloud.ply", read_ply_cloud)
    yield Kind("mesh", "stored/scan/mesh.ply", read_ply_mesh)
    yield from _imports(folder)


def _images(folder: Path) -> Iterator[Kind]:
    grey = np.arange(12 * 16, dtype=np.uint8).reshape(12, 16)
    for ending in ("png", "jpg", "bmp", "tiff"):
        cv2.imwrite(str(folder / f"image.{ending}"), grey)
        yield Kind(f"{ending} image", f"image.{ending}", read_header)
    yield Kind("png chunks", "image.png", lambda path: find_png_damage(path.read_bytes()))


def _imports(folder: Path) -> Iterator[Kind]:
    camera = Camera(900.0, 901.0, 0.0, 320.5, 255.5, Radial(-0.1, 0.05), 640, 512)
    cameras = {
        name: (camera, RigidTransform(np.eye(3), np.array([x, 0.0, 0.0])))
        for name, x in (("left", -100.0), ("right", 100.0))
    }
    for name in RIG_FORMATS.names():
        form = RIG_FORMATS.find(name)
        written = form.write(cameras, folder / "imports" / name / form.path)
        files = [written] if written.is_file() else sorted(written.rglob("*"))
        for file in files:
            if file.is_file():
                inside = str(file.relative_to(folder))
                yield Kind(f"{name} import", inside, _reading(form.read, written))


def _reading(read: Callable[[Path], object], path: Path) -> Callable[[Path], object]:
    return lambda _: read(path)


def _too_long(number: int, frame: FrameType | None) -> None:
    raise TimeoutError(f"took more than {LONGEST_S} s")


if __name__ == "__main__":
    total = int(sys.argv[1]) if len(sys.argv) > 1 else COUNT
    wrong = fuzz(total, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    errors = f"{sum(wrong.values())} errors that were not our own, of {len(wrong)} kinds"
    print(f"{total} damaged files, {errors}")
    raise SystemExit(bool(wrong))
