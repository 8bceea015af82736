"""All pairs of a scan: images to range images. A pair that fails is named and left out."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.errors import BodyscanError, ScanFailed, listed
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, attempt_each, silent
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.scan_volume import stripes_in_volume
from bodyscan.reconstruction.triangulation import reconstruct_range_image
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.stripes.stripe_map import ResponseShare
from bodyscan.workflows.decode import decode_sequence, response_notes, responses_in

Reconstructed = tuple[RangeImage, tuple[ResponseShare, ...]]
"""A range image, and what the projector's response was found to be on the way."""


def reconstruct_sequence(
    calibration: RigCalibration, captures: Captures, sequence: ImageSequence
) -> Reconstructed:
    """What one calibrated pair saw in one shot, within the scan volume and a little around it.

    Raises ImageError and DecodingFailed as `decode_sequence` does.
    """
    pair, at = calibration.pairs[sequence.pair], calibration.rig_from_camera[sequence.pair]
    limits = stripes_in_volume(pair, at, calibration.rig.volume)
    spec = calibration.rig.pair(sequence.pair)
    stripes = decode_sequence(sequence, spec, limits=limits)
    coded = spec.projector and calibration.rig.frames.of_code(spec.projector)
    time_ms = captures.middle_ms(sequence.shot, sequence.pair, coded or ())
    image = replace(reconstruct_range_image(pair, stripes), time_ms=time_ms)
    return image, tuple(responses_in(stripes))


def reconstruct_range_images(
    calibration: RigCalibration,
    captures: Captures,
    progress: Progress = silent,
    *,
    made: Mapping[ImageSequence, Reconstructed] = MappingProxyType({}),
) -> Outcome[list[RangeImage]]:
    """The range image of every calibrated pair; pairs that gave none are failures.

    They show the scan volume and a little around it. made: those of sequences that were made while
    others still arrived. Raises ScanFailed if no pair gives one.
    """
    failed = {
        pair.name: calibration.failed.get(pair.name, "is not calibrated")
        for pair in calibration.rig.pairs
        if pair.projector and pair.name not in calibration.pairs
    }
    failed |= {
        pair.name: "took no stripe sequence in this scan"
        for pair in calibration.rig.pairs
        if pair.projector
        and pair.name not in failed
        and not any(s.has_stripes for s in captures.of_pair(pair.name))
    }
    sequences = [s for s in captures.sequences if s.has_stripes and s.pair not in failed]

    def reconstruct(sequence: ImageSequence) -> Reconstructed:
        return made.get(sequence) or reconstruct_sequence(calibration, captures, sequence)

    found, errors = attempt_each(
        reconstruct, sequences, BodyscanError, stage="range images", progress=progress
    )
    failed |= {s.pair: captures.relative(str(error)) for s, error in errors.items()}
    if not found:
        raise ScanFailed(f"no pair gave a range image:{listed(failed)}")
    images = [image for image, _ in found.values()]
    responses: dict[str, list[ResponseShare]] = defaultdict(list)
    for image, shares in found.values():
        responses[image.pair] += shares
    notes = [f"{image.pair}: {image.agreement}" for image in images if image.agreement is not None]
    return Outcome(images, (*notes, *response_notes(responses)), failed)
