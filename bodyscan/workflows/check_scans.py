"""Check with ordinary scans of people whether a pair or pole is displaced from its calibrated pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from bodyscan.alignment.displaced_poles import (
    MIN_DRIFT_MM,
    DisplacementSearch,
    PairDrift,
    estimate_drift,
    find_displaced_pole,
    motions_between,
)
from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.captures.folder import Captures
from bodyscan.fusion.cleaning import clean, require_subject
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.settings import AlignmentSettings
from bodyscan.workflows.range_images import reconstruct_range_images


@dataclass(frozen=True, eq=False)
class ScanCheck:
    """What scans of people tell about a rig.

    before_mm, after_mm: of each scan, RMS distance of its overlaps before and after alignment.
    pairs: the mean motion of each pair by alignment.
    poles: the same of poles, where their pairs moved together.
    search: the search for single moves, given the time at which each pair saw the person.
    groups: groups of pairs that no overlap of any scan connects, the largest first; empty if there
        is only one group. How groups stand relative to each other is not observed: pairs that moved
        far enough share nothing.
    """

    before_mm: tuple[float, ...]
    after_mm: tuple[float, ...]
    pairs: tuple[PairDrift, ...]
    poles: tuple[PairDrift, ...]
    search: DisplacementSearch
    groups: tuple[tuple[str, ...], ...] = ()

    @property
    def detectable_mm(self) -> float:
        """The largest move of a pair or pole, mm, that could pass for a person's motion."""
        by_mean = max(drift.limit_mm for drift in (*self.pairs, *self.poles))
        return min(by_mean, self.search.detectable_mm)

    @property
    def decided(self) -> bool:
        """Whether a harmful move can be distinguished from sway, and all pairs are connected.

        Alignment corrects a pole that moved by less than 5 mm: girths are still good to 2 mm.
        """
        return self.detectable_mm <= 5.0 and not self.groups

    @property
    def quiet(self) -> bool:
        """Whether there is nothing to explain, neither sway nor a move."""
        still = all(drift.shift_mm < MIN_DRIFT_MM for drift in self.pairs)
        return still and max(self.before_mm) < 0.5 and not self.groups

    @property
    def valid(self) -> bool:
        drifted = any(drift.moved for drift in (*self.pairs, *self.poles))
        return not drifted and self.search.found is None


def check_scans(
    calibration: RigCalibration, scans: Sequence[Captures], progress: Progress = silent
) -> ScanCheck:
    """Align these scans of people and judge the rig. Raises ScanFailed if one shows nobody."""
    alignments, moments = [], []
    for captures in scans:
        images = reconstruct_range_images(calibration, captures, progress).value
        cleaned = clean(images, calibration.rig_from_camera, calibration.rig.volume)
        kept = require_subject(cleaned)
        alignments.append(
            align(kept, calibration.rig_from_camera, calibration.covariance, AlignmentSettings())
        )
        moments.append({image.pair: image.time_ms for image in kept})
    return judge_scans(alignments, calibration.rig_from_camera, calibration.rig.poles, moments)


def judge_scans(
    alignments: Sequence[Alignment],
    rig_from_camera: Mapping[str, RigidTransform],
    poles: Mapping[str, str],
    moments_ms: Sequence[Mapping[str, float | None]] | None = None,
) -> ScanCheck:
    """Judge a rig by the alignments of its scans.

    rig_from_camera: the calibrated poses.
    poles: the pole of each pair that stands on one.
    moments_ms: of each scan, the time at which each pair saw the person; None if not known.
    """
    shifts = {
        name: np.array(
            [
                (found.rig_from_camera[name] @ at.inverse()).apply(BODY_CENTRE) - BODY_CENTRE
                for found in alignments
                if name in found.rig_from_camera
            ]
        ).reshape(-1, 3)
        for name, at in rig_from_camera.items()
    }
    pairs = [estimate_drift(name, each) for name, each in sorted(shifts.items()) if len(each)]
    whole_poles = []
    for pole in sorted(set(poles.values())):
        of_pole = [shifts[n] for n in sorted(shifts) if poles.get(n) == pole and len(shifts[n])]
        if len(of_pole) > 1 and len({len(one) for one in of_pole}) == 1:
            whole_poles.append(estimate_drift(f"pole {pole}", np.mean(of_pole, axis=0)))
    if moments_ms is None:
        moments_ms = [dict.fromkeys(found.rig_from_camera) for found in alignments]
    motions = [
        motions_between(rig_from_camera, {n: found.rig_from_camera[n] for n in found.motion_mm})
        for found in alignments
    ]
    return ScanCheck(
        tuple(found.rms_before_mm for found in alignments),
        tuple(found.rms_after_mm for found in alignments),
        tuple(pairs),
        tuple(whole_poles),
        find_displaced_pole(list(zip(motions, moments_ms, strict=True)), poles),
        _separate_groups(alignments),
    )


def _separate_groups(alignments: Sequence[Alignment]) -> tuple[tuple[str, ...], ...]:
    """Connected components of the overlaps of all scans, the largest first; () if there is one."""
    graph = nx.Graph()
    for found in alignments:
        graph.add_nodes_from(found.rig_from_camera)
        graph.add_edges_from((overlap.source, overlap.target) for overlap in found.overlaps)
    groups = sorted((tuple(sorted(group)) for group in nx.connected_components(graph)), key=len)
    return tuple(groups[::-1]) if len(groups) > 1 else ()
