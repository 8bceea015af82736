"""Our reader of grey PNG files compared with others that are installed."""

from __future__ import annotations

import importlib
import io
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks import full_size
from bodyscan.captures.folder import open_scan
from bodyscan.captures.grey_png import decode_grey_png, find_png_damage
from bodyscan.registration.storage import load_calibration

RUNS, THREADS = 7, 2

Reader = Callable[[bytes], Any]


def report(workspace: Path | None = None) -> str:
    """The section of docs/results.md; the workspace is `full_size`."""
    workspace = workspace or Path(os.environ.get("BODYSCAN_BENCH", full_size.WORKSPACE))
    calibration = load_calibration(workspace / "calibration")
    first = open_scan(calibration.rig, workspace / "captures" / "person").sequences[0]
    files = [Path(path).read_bytes() for path in (first.board_path, *first.coded)]
    height, width = cv2.imdecode(np.frombuffer(files[0], np.uint8), cv2.IMREAD_GRAYSCALE).shape
    rows = []
    for name, of in READERS.items():
        try:
            reader = of(width, height)
        except ImportError:
            rows.append(f"| {name} | not installed | | |")
            continue
        one, two, processor = _times(reader, files)
        rows.append(f"| {name} | {processor:.1f} | {one:.1f} | {two:.1f} |")
    table = "\n".join(rows)
    return f"""## Reading grey PNG files

{len(files)} images of {width} x {height} pixels, {sum(map(len, files)) / len(files) / 1e3:.0f} kB
each, from memory; milliseconds an image, the fastest of {RUNS} runs. Ours checks the checksums too.

| | processor | one thread | two threads |
|---|---|---|---|
{table}
"""


def _times(reader: Reader, files: list[bytes]) -> tuple[float, float, float]:
    """Milliseconds per image: with one thread, with two, and of processor time."""
    one, two, processor = [], [], []
    for _ in range(RUNS):
        wall, cpu = time.perf_counter(), time.process_time()
        for file in files:
            reader(file)
        one.append(time.perf_counter() - wall)
        processor.append(time.process_time() - cpu)
        with ThreadPoolExecutor(THREADS) as pool:
            wall = time.perf_counter()
            list(pool.map(reader, files))
            two.append(time.perf_counter() - wall)
    fastest = (1e3 * min(times) / len(files) for times in (one, two, processor))
    return next(fastest), next(fastest), next(fastest)


def _ours(width: int, height: int) -> Reader:
    return lambda file: find_png_damage(file) or decode_grey_png(file, width, height)


def _opencv(width: int, height: int) -> Reader:
    return lambda file: cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)


def _pillow(width: int, height: int) -> Reader:
    image = importlib.import_module("PIL.Image")
    return lambda file: np.asarray(image.open(io.BytesIO(file)))


def _imagecodecs(width: int, height: int) -> Reader:
    codecs = importlib.import_module("imagecodecs")
    return lambda file: codecs.png_decode(file)


def _pyvips(width: int, height: int) -> Reader:
    vips = importlib.import_module("pyvips")
    return lambda file: vips.Image.new_from_buffer(file, "").numpy()


def _pywuffs(width: int, height: int) -> Reader:
    wuffs, aux = (importlib.import_module(name) for name in ("pywuffs", "pywuffs.aux"))
    config = aux.ImageDecoderConfig()
    config.enabled_decoders = [wuffs.ImageDecoderType.PNG]
    config.pixel_format = wuffs.PixelFormat.Y
    return lambda file: aux.ImageDecoder(config).decode(file).pixbuf


def _kornia(width: int, height: int) -> Reader:
    kornia = importlib.import_module("kornia_rs.io")
    return lambda file: kornia.decode_image_png_u8(file, (height, width), "mono")


READERS: dict[str, Callable[[int, int], Reader]] = {
    "bodyscan": _ours,
    "OpenCV": _opencv,
    "Pillow": _pillow,
    "imagecodecs": _imagecodecs,
    "pyvips": _pyvips,
    "pywuffs": _pywuffs,
    "kornia_rs": _kornia,
}
