"""What a scan's verdict is based on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from bodyscan.alignment.icp import Alignment
from bodyscan.alignment.sway_prior import compute_centre_sigmas
from bodyscan.arrays import Array, Mask
from bodyscan.fusion.consistency import Contradictions
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.motion.person_alignment import PersonAlignment
from bodyscan.motion.person_motion import PersonMotion
from bodyscan.reconstruction.range_image import Agreement
from bodyscan.registration.rig_calibration import NominalSize, RigCalibration, find_nominal_size
from bodyscan.rig.rig import Volume
from bodyscan.settings import UseLimits
from bodyscan.verdict import Grade

if TYPE_CHECKING:
    from bodyscan.mesh.sliced_parts import BodyParts

GIRTH_PER_MM = 2.0 * np.pi
"""mm by which a girth is wrong if its surface is displaced by 1 mm all round."""
BAND_MM = 50.0  # of the body's height, by which gaps are reported


@dataclass(frozen=True)
class Finding:
    """A fault of a scan."""

    grade: Grade
    words: str
    pairs: frozenset[str] = frozenset()  # those that it is about, by name; none: the whole body
    explains: frozenset[str] = frozenset()  # pairs whose own faults are a consequence of it
    # Whether it puts wrong points into the cloud, so that what the whole body looks like may be a
    # consequence as well.
    spoils: bool = False

    def explains_finding(self, other: Finding) -> bool:
        """Whether the other one is a consequence, if it is none of a cause by itself."""
        if not other.pairs:
            return self.spoils
        return 2 * len(other.pairs & self.explains) >= len(other.pairs)


@dataclass(frozen=True, eq=False)
class RigEvidence:
    """What a verdict takes from the rig and its calibration.

    unjudged: pairs with an imported calibration of unknown accuracy.
    nominal: distances between cameras compared with their nominal positions, if known.
    cameras: positions (N, 3) of all the rig's cameras; None for all round. What none of them could
        see is no reason to repeat.
    boards_mm: sigma of each pair's pose as calibrated, at the body's centre, see
        `compute_centre_sigmas`.
    """

    volume: Volume
    unjudged: tuple[str, ...] = ()
    nominal: NominalSize | None = None
    cameras: Array | None = None
    boards_mm: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def from_calibration(calibration: RigCalibration) -> RigEvidence:
        pairs, poses = calibration.pairs, calibration.rig_from_camera
        return RigEvidence(
            calibration.rig.volume,
            tuple(name for name, pair in pairs.items() if pair.quality.unjudged),
            find_nominal_size(calibration.rig, poses),
            np.array([pose.translation for pose in poses.values()]),
            compute_centre_sigmas(calibration.covariance),
        )


@dataclass(frozen=True, eq=False)
class Seam:
    """A surface that two pairs measured, by patches: distances (N,) mm and their sigmas (N,)."""

    pairs: tuple[str, str]
    distances_mm: Array
    sigma_mm: Array


@dataclass(frozen=True, eq=False)
class SeamReport:
    """A scan's seams, and the groups (poles, single pairs) that may have moved by themselves.

    isolated: groups of pairs that share no surface with the largest: their poses are not checked.
    """

    seams: tuple[Seam, ...]
    groups: Mapping[str, frozenset[str]]
    isolated: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, eq=False)
class ImageEvidence:
    """What a verdict takes from the range images."""

    failed: Mapping[str, str] = field(default_factory=dict)  # pairs that gave none, with the reason
    silent: tuple[str, ...] = ()  # poles of which no pair saw anybody, see `find_silent_poles`
    # Of overexposed pairs, the share of their pixels in the volume that are white.
    saturated: Mapping[str, float] = field(default_factory=dict)
    absent: frozenset[str] = frozenset()  # calibrated pairs that measured nothing of the subject
    # Of pairs that project stripes of two directions.
    agreements: Mapping[str, Agreement] = field(default_factory=dict)
    seams: SeamReport | None = None  # see `find_seams`
    contradictions: Contradictions | None = None  # see `merge`
    floor_mm: float | None = None  # height at which the floor was measured, see `find_floor`
    compressed: tuple[str, ...] = ()  # pairs with images as JPEG leaves them, see `find_compressed`
    nonlinear: tuple[str, ...] = ()  # pairs whose grey levels are not proportional to light
    # Pairs whose images are another's, and whose: see `find_exchanged`.
    exchanged: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Coverage:
    """A sample of N faces of the mesh, and how much of them each pair measured.

    heights_mm, areas_mm2: heights of the faces, and areas that they stand for, (N,).
    filled, missed: whether no pair measured them, and whether besides one looks there that gave no
        range image, (N,).
    yields, saturated: by pair, shares that it measured, and that are white in its lit image, of the
        faces that it sees and others measured.
    """

    heights_mm: Array
    areas_mm2: Array
    filled: Mask
    yields: Mapping[str, float]
    saturated: Mapping[str, float]
    missed: Mask

    def sum_bands(self, areas_mm2: Array) -> Array:
        """Areas (N,) of the faces summed in bands of BAND_MM in height, from the floor up."""
        band = np.maximum(self.heights_mm / BAND_MM, 0.0).astype(np.int64)
        return np.asarray(np.bincount(band, areas_mm2), np.float64)

    @property
    def filled_share(self) -> float:
        return float(self.areas_mm2[self.filled].sum() / max(self.areas_mm2.sum(), 1e-12))


@dataclass(frozen=True, eq=False)
class ScanEvidence:
    """Everything that the checks of a scan look at.

    person_alignment: the result of alignment; None if it took no part.
    person: how a moving body moved.
    mesh, coverage: None while there is no mesh; findings that need it are then left out.
    find_parts: gives the parts of the mesh, see `find_mesh_parts`.
    """

    cloud: BodyCloud
    rig: RigEvidence
    images: ImageEvidence
    use: UseLimits
    person_alignment: PersonAlignment | None = None
    person: PersonMotion | None = None
    mesh: BodyMesh | None = None
    coverage: Coverage | None = None
    find_parts: Callable[[], BodyParts] | None = None

    @property
    def alignment(self) -> Alignment | None:
        return self.person_alignment.alignment if self.person_alignment else None

    @property
    def poses_corrected(self) -> bool:
        """Whether alignment found displaced poles, or all poles farther out, and corrected them."""
        return bool(
            self.person_alignment
            and (self.person_alignment.displaced or self.person_alignment.common_error)
        )

    @property
    def shape(self) -> BodyMesh | None:
        """The mesh unless more than half is filled: filled surface may have any shape."""
        if self.mesh is None:
            return None
        filled = self.coverage.filled_share if self.coverage else self.mesh.filled_share
        return self.mesh if filled <= 0.5 else None

    @cached_property
    def parts(self) -> BodyParts | None:
        """The parts of the body, None without a `shape`."""
        return self.find_parts() if self.find_parts and self.shape else None


Check = Callable[[ScanEvidence], Iterable[Finding]]
"""Yields a grade and a message for each fault of a scan."""
