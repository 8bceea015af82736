"""Run all benchmarks, or those named, and write what they print into docs/results.md.

python -m benchmarks [NAME ...]    (the names are the keys of BENCHMARKS)
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import platform
import sys
from collections.abc import Callable
from pathlib import Path

from benchmarks import charuco_ring, codes, full_size, fusion, lens, png, procam, rig
from bodyscan.files.atomic import write_text

PROJECT = Path(__file__).parents[1]
RESULTS = PROJECT / "docs" / "results.md"
BENCHMARKS: dict[str, Callable[[], str]] = {
    "three-pole": full_size.three_pole,
    "four-pole": full_size.four_pole,
    "sway": full_size.sway,
    "fusion": fusion.report,
    "png": png.report,
    "rig": rig.report,
    "procam": procam.report,
    "charuco-ring": charuco_ring.report,
    "codes": codes.report,
    "lens": lens.report,
}


def main() -> None:
    """Sections that are not run keep what the last run found."""
    named = sys.argv[1:] or list(BENCHMARKS)
    sections = _sections()
    for name in named:
        sections[name] = BENCHMARKS[name]().strip()
        print(sections[name], flush=True)
    head = (
        "# Results\n\nWritten by `make bench` (`python -m benchmarks`); each section says how it was "
        f"got.\nMachine: {os.cpu_count()} cores, {platform.machine()}, "
        f"Python {platform.python_version()}; load average {os.getloadavg()[1]:.1f}.\n"
    )
    body = [f"<!-- {name} -->\n{sections[name]}\n" for name in BENCHMARKS if name in sections]
    write_text(RESULTS, "\n".join([head, *body]))


def _sections() -> dict[str, str]:
    if not RESULTS.exists():
        return {}
    parts = RESULTS.read_text("utf-8").split("<!-- ")[1:]
    return {name: text.strip() for name, text in (part.split(" -->\n", 1) for part in parts)}


if __name__ == "__main__":
    main()
