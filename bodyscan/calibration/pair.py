"""One pair by itself, as the chapter does it (3.3): its camera, then a plane for each stripe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.light_choice import HeldOutModel
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import LightSheets

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PairQuality:
    """Figures of one pair: corners' RMS (px) over `poses` board poses; distances of boundary points
    to their sheets, RMS (mm), over `stripe_shots` boards; boundaries with a sheet, of those thrown.

    held_out: every model of the light tried on boards it was not fitted to, simplest first.
    refinement: of a pair by itself, whether camera, boards and light were refined together and why;
    flatness_mm: RMS of held-out boards about their own planes, before and after.
    boards_mm: mean and RMS over the boards of how far the stripes measure them from where the
    corners of all cameras put them.
    """

    corners_rms_px: float
    poses: int
    planes_rms_mm: float | None = None
    stripe_shots: int = 0
    stripes_calibrated: int = 0
    stripes_projected: int = 0
    held_out: tuple[HeldOutModel, ...] = ()
    refinement: str = ""
    flatness_mm: tuple[float, float] | None = None
    boards_mm: tuple[float, float] | None = None

    @property
    def light_model(self) -> str | None:
        """The model of the light that held-out boards chose."""
        return next((tried.model for tried in self.held_out if tried.chosen), None)


@dataclass(frozen=True, eq=False)
class PairCalibration:
    """A calibrated pair, camera frame.

    camera_covariance: (P, P) of the camera's parameters.
    light: None for a camera without projector.
    """

    name: str
    camera: Camera
    camera_covariance: Array
    light: LightSheets | None
    quality: PairQuality
