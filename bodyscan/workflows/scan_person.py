"""Scan one person: images to range images, and these to a body cloud and a closed mesh."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.fusion.scan import Made, Scan, no_use
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.settings import ScanSettings
from bodyscan.verdict import Announce, say_nothing
from bodyscan.workflows.fuse_range_images import fuse
from bodyscan.workflows.range_images import Reconstructed, reconstruct_range_images


def scan_person(
    calibration: RigCalibration,
    captures: Captures,
    settings: ScanSettings,
    progress: Progress = silent,
    *,
    empty: Captures | None = None,
    reconstructed: Mapping[ImageSequence, Reconstructed] = MappingProxyType({}),
    announce: Announce = say_nothing,
    made: Made = no_use,
) -> Scan:
    """Make a body model and mesh from images of a person.

    empty: captures of the rig with nobody in it, whose surfaces are not part of the subject.
    reconstructed: see `reconstruct_range_images`.
    announce, made: see `fuse`.

    Raises ScanFailed if no pair, or no part of a body inside the scan volume, is left.
    """
    images = reconstruct_range_images(
        calibration, captures, progress, made=reconstructed, volume_only=True
    )
    nobody = empty and reconstruct_range_images(calibration, empty, progress, volume_only=True)
    background = nobody.value if nobody else ()
    return fuse(
        calibration,
        images,
        settings,
        progress,
        empty=background,
        announce=announce,
        made=made,
    )
