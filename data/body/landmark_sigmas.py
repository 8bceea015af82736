"""Measure how well landmarks and measures are found on bodies of random shape and pose.

    PYTHONPATH=. /tmp/anny/bin/python data/body/landmark_sigmas.py

Writes sigmas.json, and `sigma_mm` of every measure into its file. Half of the bodies have surface that
the template's shapes cannot make, and all are seen as by three-pole-12 (`random_bodies`). Synthetic:
people differ by more than that.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from random_bodies import TEMPLATE, Array, lay_truth, make_bodies, scan_body

from bodyscan.body_model.registered import register_body
from bodyscan.body_model.template import drop_side
from bodyscan.errors import BadInput
from bodyscan.measurement.named import (
    NamedMeasures,
    locate_section,
    read_definitions,
    take_measures,
)

SEEDS = range(100, 123)
REACH_MM = 2050.0
"""Highest that three-pole-12 sees: a head above it is cut off."""
FOLDER = Path(__file__).parents[2] / "bodyscan" / "measurement" / "measures"
Errors = dict[str, list[float]]


def add_landmark_errors(errors: Errors, found: NamedMeasures, true: NamedMeasures) -> None:
    """Absolute errors by axis, both sides together."""
    for name in found.landmarks:
        off = np.subtract(found.landmarks[name].position_mm, true.landmarks[name].position_mm)
        errors.setdefault(drop_side(name), []).extend(np.abs(off).tolist())


def add_measure_errors(errors: Errors, found: NamedMeasures, true: NamedMeasures) -> None:
    """Absolute errors of the levels of sections, and of the values of all others."""
    here, there = locate(found), locate(true)
    for definition in read_definitions():
        name = definition["name"]
        if name not in found.measures or name not in true.measures:
            continue
        off = found.measures[name].mm - true.measures[name].mm
        if "part" in definition:
            _, centres = locate_section(here, definition)
            axis, right = locate_section(there, definition)
            off = float(axis @ (centres - right).mean(axis=0))
        errors.setdefault(drop_side(name), []).append(abs(off))


def locate(named: NamedMeasures) -> dict[str, Array]:
    """Positions (3,) of all landmarks, body frame."""
    to_body = named.body.rig_from_body.inverse()
    return {name: to_body.apply(np.array(one.position_mm)) for name, one in named.landmarks.items()}


def compute_sigmas(errors: Errors) -> dict[str, float]:
    """95 % quantiles over 1.96, of both sides together."""
    return {
        name: round(max(0.1, float(np.quantile(some, 0.95)) / 1.96), 1)
        for name, some in sorted(errors.items())
    }


def write_measures(sigmas: dict[str, float]) -> None:
    """Replace the line `sigma_mm` of every measure's file."""
    for name, sigma in sigmas.items():
        path = FOLDER / f"{name.replace(' ', '-')}.yaml"
        text = re.sub(r"^sigma_mm: .*\n", "", path.read_text(), flags=re.MULTILINE)
        path.write_text(f"{text}sigma_mm: {sigma}\n")


def main() -> None:
    of_landmarks, of_measures = Errors(), Errors()
    for body in make_bodies(SEEDS):
        if body.vertices[:, 2].max() > REACH_MM:
            continue
        try:
            registered = register_body(scan_body(body))
        except BadInput as error:
            print(f"{body.seed}: {error}", flush=True)
            continue
        found = take_measures(registered)
        true = take_measures(lay_truth(body, registered))
        add_landmark_errors(of_landmarks, found, true)
        add_measure_errors(of_measures, found, true)
    sides = compute_sigmas(of_landmarks)
    sigmas = {name: sides[drop_side(name)] for name in sorted(TEMPLATE.landmarks)}
    Path(__file__).with_name("sigmas.json").write_text(json.dumps(sigmas, indent=1) + "\n")
    write_measures(compute_sigmas(of_measures))


if __name__ == "__main__":
    main()
