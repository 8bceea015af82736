"""The file that describes an acceptance test: the artefacts as calibrated, and the limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from bodyscan.errors import BadInput
from bodyscan.files.model import Model, Problem
from bodyscan.files.model_file import apply_changes, load_model

_REMEDY = "Correct the acceptance file; docs/report.md explains every key."
MOST_SPHERES = 6
"""Most spheres: they are identified by trying every order of them."""

Positive = Annotated[float, Field(gt=0)]
Vector = tuple[float, float, float]


class AcceptanceError(BadInput):
    """The acceptance file, or a --limit, is wrong."""


class Spheres(Model):
    """Spheres on one carrier: their calibrated radius, and centres in the carrier's own frame."""

    radius_mm: Positive = 60.0
    centres_mm: tuple[Vector, ...] = Field(
        default=((0.0, 0.0, 0.0), (500.0, 0.0, 0.0)), min_length=1, max_length=MOST_SPHERES
    )

    def problems(self) -> Iterator[Problem]:
        for k, centre in enumerate(self.centres_mm):
            for j, other in enumerate(self.centres_mm[:k]):
                if np.linalg.norm(np.subtract(centre, other)) < 2.0 * self.radius_mm:
                    yield ("centres_mm", k), f"lies inside sphere {j + 1} (got {centre})"


class Plate(Model):
    """A flat plate: its width and height."""

    size_mm: tuple[Positive, Positive] = (400.0, 300.0)


class Limits(Model):
    """Largest values allowed, mm; figures without a limit are reported but not judged."""

    probing_form_mm: Positive | None = None
    probing_size_mm: Positive | None = None
    sphere_spacing_mm: Positive | None = None
    flatness_mm: Positive | None = None
    repeatability_mm: Positive | None = None
    single_probing_form_mm: Positive | None = None
    single_flatness_mm: Positive | None = None


class AcceptanceFile(Model):
    """The whole acceptance file."""

    version: Literal[1] = 1
    spheres: Spheres = Spheres()
    plate: Plate = Plate()
    limits: Limits = Limits()


def load_acceptance(path: Path | None, changes: Mapping[str, float] = {}) -> AcceptanceFile:
    """Read an acceptance file, or take the defaults if `path` is None, and change some limits.

    Raises AcceptanceError that names every problem.
    """
    file = (
        AcceptanceFile()
        if path is None
        else load_model(path, AcceptanceFile, AcceptanceError, remedy=_REMEDY)
    )
    if not changes:
        return file
    return apply_changes(
        file, {("limits", name): value for name, value in changes.items()}, AcceptanceError
    )


def limit_from(text: str) -> tuple[str, float]:
    """Parse `flatness_mm=0.5` into name and value. Raises AcceptanceError."""
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise AcceptanceError(
            f"{text!r} is not a limit", remedy="write it as --limit flatness_mm=0.5"
        ) from None
