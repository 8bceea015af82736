"""Calibrate a rig and scan a person: `python examples/calibrate_and_scan.py [FOLDER [OUT]]`.

FOLDER holds rig.yaml, the board images that it names, and one person's images in captures/person.
Without FOLDER, twelve small pairs, a board and a person are simulated, which takes some minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import bodyscan

PROJECT = Path(__file__).parents[1]
# Half the default resolution, whose mesh takes four times as long.
QUICK = bodyscan.ScanSettings(
    fusion=bodyscan.FusionSettings(points=100_000), mesh=bodyscan.MeshSettings(depth=8, reach_mm=8)
)


def main(folder: Path, out: Path) -> None:
    """From images to a calibrated rig, a measured body and files for other programs."""
    calibration = bodyscan.calibrate_rig(folder / "rig.yaml")
    bodyscan.save_calibration(calibration, out / "calibration")
    for pair, reason in calibration.failed.items():
        print(f"left out: {pair}: {reason}")
    for line in calibration.advice:
        print(line)

    person = bodyscan.scan(folder / "captures" / "person", calibration, QUICK)
    print(person.verdict)

    body = bodyscan.measure(person)
    print(f"stature in pose {body.stature_mm:.0f} mm, volume {body.volume_l:.1f} l")
    for level in body.slices:
        for part in level.girths:
            print(f"{level.height_mm:6.0f} mm  {part.part:9}  {part.tape_mm:7.1f} mm by tape")

    kept = bodyscan.save_scan(person, out / "person", calibration=out / "calibration")
    for path in bodyscan.export_scan(
        kept, out / "export", bodyscan.ExportSettings(formats=("glb",))
    ):
        print(f"written: {path}")


def simulate(folder: Path) -> None:
    """Simulate a rig with everything around it, at a quarter of the real image size."""
    from bodyscan.simulation import simulate as run

    subject = PROJECT / "data" / "subjects" / "woman_average.ply"
    run(PROJECT / "rigs" / "three-pole-12.yaml", folder, subject=subject, scale=0.25)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]), Path(sys.argv[-1]))
    else:
        with TemporaryDirectory() as made:
            simulate(Path(made))
            main(Path(made), Path(made))
