"""Run by try-wheel.sh in an environment that holds a wheel and what it asks for, nothing else.

The first run simulates captures, for which the second, of bodyscan-core, lacks Open3D.
"""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import yaml

import bodyscan

RIG, SUBJECT = Path("begun/rig.yaml"), Path("begun/woman_average.ply")  # by `init`
PAIRS = ("p1-2", "p1-3", "p2-2", "p2-3")


def run(*arguments: object, or_code: int = 0) -> None:
    """The command as a user types it: the entry point that the wheel brings."""
    print("bodyscan", *arguments, flush=True)
    command = [str(Path(sys.prefix) / "bin" / "bodyscan"), *map(str, arguments)]
    if (code := subprocess.run(command, check=False).returncode) not in (0, or_code):
        sys.exit(f"bodyscan {arguments[0]} ended with {code}")


def small_rig(path: Path) -> Path:
    """Two poles of three, two pairs each."""
    rig = yaml.safe_load(RIG.read_text("utf-8"))
    rig["pairs"] = [pair for pair in rig["pairs"] if pair["name"] in PAIRS]
    rig["rig_frame"] = {"pair": PAIRS[0]}
    path.write_text(yaml.safe_dump(rig, sort_keys=False), "utf-8")
    return path


def main() -> None:
    installed = Path(bodyscan.__file__).resolve()
    if not installed.is_relative_to(Path(sys.prefix).resolve()):
        sys.exit(f"this is no wheel: bodyscan comes from {installed}")
    size = ("--scale", 0.25, "--board-shots", 6, "--preset", "ideal")
    subject = ("--subject", SUBJECT, "--subject-preset", "mannequin")
    if not Path("work").exists():
        run("init", "begun")
        run("simulate", small_rig(Path("rig.yaml")), "--out", "work", *size, *subject)
    elif find_spec("open3d") or find_spec("pycolmap"):
        sys.exit("bodyscan-core brings Open3D or pycolmap")
    run("calibrate-rig", "work/rig.yaml", "--overwrite", or_code=1)  # so few boards fix little
    scan = ("--calibration", "work/calibration", "--out", "work/scan", "--points", 20_000)
    # So few pixels on two poles are half a body, which the verdict may find too little: code 1.
    run("scan", "work/captures/person", *scan, "--overwrite", or_code=1)
    run("export", "work/scan", "--out", "work/export", "--anyway")
    run("measure", "work/scan", "--anyway")
    for result in ("calibration", "scan"):
        page = Path(f"{result}.html")
        run("report", f"work/{result}", "--out", page)
        text = page.read_text("utf-8")
        if "Verdict" not in text or "<style>" not in text or "<script" not in text:
            sys.exit(f"the report of the {result} lacks its verdict, its style or its viewer")
    print(f"the wheel works: {installed.parent}")


if __name__ == "__main__":
    main()
