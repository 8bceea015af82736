"""Import a calibration made elsewhere, as the rig file gives it; nothing is solved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.known_pair import KnownPair, compute_parameter_sigmas, read_known_pair
from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.errors import BadInput, BodyscanError, CalibrationFileError
from bodyscan.files.messages import make_paths_relative
from bodyscan.geometry.transforms import RigidTransform, adjoint
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.rig_frame import rig_from_world
from bodyscan.registration.storage import archive_previous, save_calibration
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig, load_rig


def import_folder(
    rig_file: Path, folder: Path, sigma_px: float | None = None
) -> tuple[RigCalibration, Path]:
    """Import a rig as `import_rig` does and save it in `folder`; return it and its JSON's path."""
    rig = load_rig(rig_file)
    found = import_rig(rig, Path(rig_file).parent, sigma_px)
    archive_previous(folder)
    return found, save_calibration(found, folder)


def import_rig(rig: Rig, folder: Path, sigma_px: float | None = None) -> RigCalibration:
    """Import the pairs whose calibration the rig file names, in files relative to `folder`.

    sigma_px: sigma of the pixels of all pairs, overriding the rig file's.

    The rig frame is the one in which `rig_frame` puts its pair, or else the one in which the first
    pair has its `nominal` pose; without either it is the world of the files. A pair whose file is
    wrong is in `failed`. Raises BadInput if no pair is left or a board is to fix the rig frame.
    """
    if rig.rig_frame.shot is not None:
        raise BadInput(
            "the rig frame is to be fixed by a board, but an import reads no images",
            where=f"rig {rig.name}",
            remedy="name a pair in `rig_frame`, or leave it out to take the frame of the files",
        )
    known: dict[str, KnownPair] = {}
    failed: dict[str, BodyscanError] = {}
    for pair in rig.pairs:
        try:
            known[pair.name] = _read(pair, folder, posed=_needs_pose(rig, pair))
        except BodyscanError as error:
            failed[pair.name] = error
    if not known:
        raise next(iter(failed.values()))
    if sigma_px is not None:
        known = {name: replace(one, sigma_px=sigma_px) for name, one in known.items()}
    rig_from_camera = {
        name: (one.camera_from_world or RigidTransform.identity()).inverse()
        for name, one in known.items()
    }
    rig_frame = rig_from_world(rig, rig_from_camera)
    if rig_frame is not None:
        rig_from_camera = {name: rig_frame @ pose for name, pose in rig_from_camera.items()}
    return RigCalibration(
        rig,
        {name: _make_calibration(rig.pair(name), one) for name, one in known.items()},
        rig_from_camera,
        _compute_covariance(known, rig_from_camera),
        {},
        {name: make_paths_relative(str(error), folder) for name, error in failed.items()},
        tuple(
            f"{name}: imported from {one.source}; "
            + (
                "its accuracy is not known: sigmas of scans cover the decoding alone"
                if one.sigma_px is None
                else f"taken to be accurate to {one.sigma_px:g} px"
            )
            for name, one in known.items()
        ),
    )


def find_known_errors(rig_file: Path) -> list[str]:
    """Find errors in the files that a rig file names as `known`; one or two lines each."""
    errors = []
    for pair in load_rig(rig_file).pairs:
        try:
            if pair.known is not None:
                read_known_pair(pair, Path(rig_file).parent)
        except BodyscanError as error:
            errors.append(f"pair {pair.name}: {error}")
    return errors


def _needs_pose(rig: Rig, pair: Pair) -> bool:
    """A pair needs a pose unless it is the rig's only pair, or the only one whose `known` names no
    rotation: that camera is then the world frame."""
    worlds = [
        one.name
        for one in rig.pairs
        if one.known and one.known.camera.nodes and not one.known.camera.rotation
    ]
    return len(rig.pairs) > 1 and worlds != [pair.name]


def _read(pair: Pair, folder: Path, *, posed: bool) -> KnownPair:
    if pair.known is None:
        raise CalibrationFileError(
            "the rig file does not say where this pair is calibrated",
            where=f"pair {pair.name}",
            remedy="add `known` with its file and format; docs/formats.md shows how",
        )
    if pair.projector is not None and pair.known.projector is None:
        raise CalibrationFileError(
            "the rig file does not say where its projector is calibrated",
            where=f"pair {pair.name}",
            remedy="add `projector` to its `known`; calibrate-rig measures one that is not known",
        )
    known = read_known_pair(pair, folder)
    if posed and known.camera_from_world is None:
        raise CalibrationFileError(
            "does not say where the camera stands, which all but one of a rig need",
            where=f"pair {pair.name}: {known.source}",
            remedy="give rotation and translation below `known.camera` in the rig file, or another "
            "format",
        )
    return known


def _make_calibration(pair: Pair, known: KnownPair) -> PairCalibration:
    camera, code = known.camera, pair.projector
    covariance = np.zeros((len(camera.parameters),) * 2)
    if known.sigma_px is not None:
        covariance = np.diag(compute_parameter_sigmas(camera, known.sigma_px) ** 2)
    quality = PairQuality(None, 0, imported=known.source, imported_sigma_px=known.sigma_px)
    if code is None:
        return PairCalibration(pair.name, camera, covariance, None, quality)
    boundaries = code.stripes - 1
    quality = replace(quality, stripes_calibrated=boundaries, stripes_projected=boundaries)
    crossing = known.sheets(code.crossing) if code.crossing else None
    return PairCalibration(pair.name, camera, covariance, known.sheets(code), quality, crossing)


def _compute_covariance(
    known: dict[str, KnownPair], rig_from_camera: dict[str, RigidTransform]
) -> PoseCovariance:
    """Covariance of the poses: each pair independently rotated by the sigma of its pixels, and shifted
    by as much at the surface, 1300 mm away; zero for a single pair, which defines the rig frame.

    Where a calibration states no sigma, 1 px: alignment must know how far pairs may be displaced.
    """
    names = tuple(sorted(known))
    matrix = np.zeros((6 * len(names),) * 2)
    for k, name in enumerate(names if len(names) > 1 else ()):
        one = known[name]
        turn = (one.sigma_px or 1.0) / one.camera.alpha
        sigmas = np.repeat([turn, 1300.0 * turn], 3)
        to_rig: Array = adjoint(rig_from_camera[name])
        matrix[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = to_rig @ np.diag(sigmas**2) @ to_rig.T
    return PoseCovariance(names, matrix)
