"""Measure how well landmarks are found on bodies of random shape and pose: writes sigmas.json.

    PYTHONPATH=. /tmp/anny/bin/python data/body/landmark_sigmas.py

Half of the bodies have surface that the template's shapes cannot make, and all are seen as by three
poles of cameras (`random_bodies`). Synthetic: people differ by more than that.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from random_bodies import TEMPLATE, Array, lay_truth, make_bodies, scan_body

from bodyscan.body_model.registered import RegisteredBody, register_body
from bodyscan.measurement.landmarks import find_landmarks

SEEDS = range(100, 120)


def locate(body: RegisteredBody) -> Array:
    """Positions (L, 3) of all landmarks, in the template's order."""
    found = find_landmarks(body)
    return np.array([found[name].position_mm for name in TEMPLATE.landmarks])


def main() -> None:
    errors = []
    for body in make_bodies(SEEDS):
        found = register_body(scan_body(body))
        errors.append(locate(found) - locate(lay_truth(body, found)))
        distance = np.linalg.norm(errors[-1], axis=1)
        middle, most = np.quantile(distance, (0.5, 0.95))
        print(f"{body.seed}: median {middle:.1f}, 95 % {most:.1f} mm", flush=True)
    # Both sides together.
    sides: dict[str, list[Array]] = {}
    for k, name in enumerate(TEMPLATE.landmarks):
        both = name.removeprefix("left ").removeprefix("right ")
        sides.setdefault(both, []).append(np.abs([error[k] for error in errors]).ravel())
    spread = {both: np.quantile(np.concatenate(some), 0.95) / 1.96 for both, some in sides.items()}
    sigmas = {
        name: round(float(spread[name.removeprefix("left ").removeprefix("right ")]), 1)
        for name in sorted(TEMPLATE.landmarks)
    }
    Path(__file__).with_name("sigmas.json").write_text(json.dumps(sigmas, indent=1) + "\n")


if __name__ == "__main__":
    main()
