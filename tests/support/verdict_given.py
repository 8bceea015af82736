"""A scan's verdict from a few facts by name, all others being sound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

import numpy as np

from bodyscan.alignment.displaced_poles import DisplacementSearch
from bodyscan.alignment.icp import Alignment
from bodyscan.fusion.verdict import grade_scan
from bodyscan.fusion.verdict.evidence import Coverage, ImageEvidence, RigEvidence, ScanEvidence
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.sliced_parts import find_mesh_parts
from bodyscan.motion.person_alignment import PersonAlignment
from bodyscan.motion.person_motion import PersonMotion
from bodyscan.rig.rig import Volume
from bodyscan.settings import UseLimits
from bodyscan.verdict import Verdict

Evidence = TypeVar("Evidence", RigEvidence, ImageEvidence, PersonAlignment)
SOUND: dict[type, dict[str, Any]] = {
    RigEvidence: {"volume": Volume()},
    ImageEvidence: {},
    PersonAlignment: {
        "alignment": Alignment({}, {}, {}, ()),
        "motion": None,
        "displaced": (),
        "common_error": None,
        "search": DisplacementSearch(None, np.inf),
    },
}


def verdict_given(
    cloud: BodyCloud,
    mesh: BodyMesh | None = None,
    *,
    use: UseLimits = UseLimits(),  # noqa: B008  (frozen)
    person: PersonMotion | None = None,
    coverage: Coverage | None = None,
    **given: Any,
) -> Verdict:
    """given: fields of RigEvidence, of ImageEvidence and of PersonAlignment."""
    rig, images = _evidence(RigEvidence, given), _evidence(ImageEvidence, given)
    together = _evidence(PersonAlignment, given)
    assert not given, f"no evidence has {', '.join(given)}"
    parts = None if mesh is None else partial(find_mesh_parts, mesh.vertices, mesh.faces)
    evidence = ScanEvidence(cloud, rig, images, use, together, person, mesh, coverage, parts)
    return grade_scan(evidence)


def _evidence(kind: type[Evidence], given: dict[str, Any]) -> Evidence:
    own: Mapping[str, Any] = {
        field.name: given.pop(field.name) for field in fields(kind) if field.name in given
    }
    return kind(**{**SOUND[kind], **own})
