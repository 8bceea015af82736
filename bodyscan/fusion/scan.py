"""One person: the body model, how it came about and whether it is good."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bodyscan.alignment.body_parts import PersonMotion
from bodyscan.alignment.icp import Alignment
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.verdict import Verdict

Made = Callable[[BodyCloud | BodyMesh], None]
"""Called with a scan's cloud, and then with its mesh, as soon as each exists; from any thread."""


def no_use(body: BodyCloud | BodyMesh) -> None:
    """A `Made` that does nothing."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A body model, how it was made, and whether it is good.

    measured: number of points in each pair's cleaned range image.
    failed: pairs that gave none, with the reason.
    range_images: cleaned, of the pairs that saw the subject, cropped to it and carried to one
        moment.
    rig_from_camera: each pair's pose relative to the subject, after alignment.
    person: how a moving body moved, part by part.
    notes: on the range images, such as stripes that were not used.
    """

    cloud: BodyCloud
    mesh: BodyMesh
    alignment: Alignment | None
    measured: dict[str, int]
    failed: dict[str, str]
    verdict: Verdict
    range_images: tuple[RangeImage, ...]
    rig_from_camera: dict[str, RigidTransform]
    person: PersonMotion | None = None
    notes: tuple[str, ...] = ()
