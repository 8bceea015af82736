"""The simulator as a camera: each time a pair comes round again, the next person stands there. A shot
of the board shows it where `simulate` holds it in the shot of that name.

Times are those of the simulated scene, in which frames follow each other as `simulation.settings.Pace`
has it, whatever order the rig file asks for.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import Field

from bodyscan.capture.cameras import Camera, CameraKind, Picture, Place
from bodyscan.capture.cameras.folder import FolderCamera
from bodyscan.files.atomic import scratch_folder
from bodyscan.rig.rig import write_rig


class SimulatedKind(CameraKind):
    """Who is rendered, and how.

    subject: surface of a body (PLY), relative to the rig file.
    seed: of the rig, as `simulate --seed`; preset and person as its `--preset` and
        `--subject-preset`.
    samples: the image is sampled at samples x samples points per pixel.
    """

    kind: Literal["simulated"]
    subject: str
    seed: int = 0
    preset: Literal["ideal", "workshop"] = "workshop"
    person: Literal["mannequin", "standing", "restless", "child"] = "standing"
    samples: int = Field(default=3, ge=1, le=8)

    def open(self, place: Place) -> Camera:
        key = self.model_dump_json()
        if key not in place.shared:
            scratch = place.closing.enter_context(scratch_folder())
            place.shared[key] = _Scene(self, place, scratch)
        return SimulatedCamera(place, place.shared[key])


class _Scene:
    """What all cameras of a rig look at: one person, or board, at a time.

    times: of each pair's frames, ms since the first pair began.
    """

    def __init__(self, kind: SimulatedKind, place: Place, scratch: Path) -> None:
        self._kind, self._place, self._scratch = kind, place, scratch
        self._seen: set[str] = set()
        self._number, self._persons, self._shot = 0, 0, ""
        self.folder = scratch / "none"
        self.times: dict[str, dict[str, float]] = {}

    def meet(self, pair: str, shot: str) -> None:
        """A pair begins a shot: with whom or what is there, or the next if it has seen that."""
        if pair in self._seen or shot != self._shot:
            self._render(shot)
        self._seen.add(pair)

    def _render(self, shot: str) -> None:
        from bodyscan.simulation import compose_settings, simulate, simulate_board
        from bodyscan.simulation.files import compute_person_times
        from bodyscan.simulation.simulate import CALIBRATION, PERSON, PERSON_SHOT

        kind, rig = self._kind, self._place.rig
        settings = compose_settings("mirror", preset=kind.preset, subject=kind.person)
        settings = replace(settings, optics=replace(settings.optics, samples=kind.samples))
        out, rig_file = self._scratch / f"shot-{self._number}", self._scratch / "rig.yaml"
        write_rig(rig_file, rig)
        if shot == PERSON_SHOT:
            simulate(
                rig_file, out, subject=self._place.base / kind.subject, seed=kind.seed,
                take=self._persons, settings=settings, board_shots=0,
            )  # fmt: skip
            self._persons += 1
        else:
            simulate_board(rig_file, out, shot, seed=kind.seed, settings=settings)
        self.times = compute_person_times(rig, shot, settings.pace)
        shutil.rmtree(self._scratch / f"shot-{self._number - 1}", ignore_errors=True)
        self.folder = out / (PERSON if shot == PERSON_SHOT else CALIBRATION)
        self._seen, self._shot, self._number = set(), shot, self._number + 1


class SimulatedCamera(FolderCamera):
    """Hands over what was rendered, by the clock of the scene."""

    has_clock, is_simulated = True, True

    def __init__(self, place: Place, scene: _Scene) -> None:
        super().__init__(place, scene.folder)
        self._scene, self._frame = scene, ""

    def begin(self, shot: str, frames: Sequence[str]) -> None:
        self._scene.meet(self._place.pair.name, shot)
        self.folder = self._scene.folder
        super().begin(shot, frames)

    def trigger(self, frame: str) -> None:
        self._frame = frame
        super().trigger(frame)

    def take(self, timeout_s: float) -> Picture:
        taken = super().take(timeout_s)
        middle_ms = self._scene.times[self._place.pair.name][self._frame]
        return replace(taken, began_ms=middle_ms, clock="simulated scene")


FORMAT = SimulatedKind
