"""Mean and spread of a day's people: `python examples/mean_body.py DAY/models MEAN.npz`.

Of the files of `bodyscan batch ... --set export.versions=registered`, or of `bodyscan export
--registered`: all have one topology, and their mesh is in one pose however the people stood.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np


def read_positions(path: Path) -> np.ndarray:
    """Vertices (V, 3) of a GLB in the rest pose, mm, its axes: left, up, front."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    content = json.loads(data[20 : 20 + size])
    number = content["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    start = content["bufferViews"][content["accessors"][number]["bufferView"]]["byteOffset"]
    count = 3 * content["accessors"][number]["count"]
    return 1000.0 * np.frombuffer(data, "<f4", count, 28 + size + start).reshape(-1, 3)


def main(models: Path, out: Path) -> None:
    people = np.array([read_positions(path) for path in models.rglob("body-registered.glb")])
    mean, spread = people.mean(axis=0), np.linalg.norm(people.std(axis=0), axis=1)
    np.savez(out, mean=mean, spread=spread)
    print(f"{len(people)} people, {np.ptp(mean[:, 1]):.0f} mm tall on average; they differ by")
    print(f"{np.median(spread):.0f} mm at half of the surface, {spread.max():.0f} mm at most")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
