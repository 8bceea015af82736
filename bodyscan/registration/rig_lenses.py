"""The lens of each camera in a rig of several, chosen after all were solved with the richest one.

So no view is thought wrong because a lens was too simple, and boards found to be bent test the
lenses in their true shape. Cameras of a rig are usually of one make: what none can prove alone, all
may prove together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import ChosenLens, LensTrial, choose_lens
from bodyscan.calibration.model_selection import MIN_GAIN
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import FAMILY
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import RayUncertainty
from bodyscan.progress import map_threads
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.rig.pair import AUTO
from bodyscan.rig.rig import Rig


def lens_notes(trials: Mapping[str, Sequence[LensTrial]]) -> list[str]:
    """One line for each camera that the chapter's lens clearly does not describe."""
    return [
        f"{name}: lens {chosen.kind}, by {chosen.gain:.0f} standard errors: boards held out fit to "
        f"{chosen.rms_px:.3f} px with it, {tried[0].rms_px:.3f} with {tried[0].kind}"
        for name, tried in trials.items()
        for chosen in tried
        if chosen.chosen and chosen.gain is not None and chosen.gain >= MIN_GAIN
    ]


@dataclass(frozen=True, eq=False)
class ChosenLenses:
    """The solution with the chosen lenses.

    trials: by camera whose lens was open, how each lens did.
    rays: by camera, how well the corners determine each pixel's ray if they err independently.
    """

    solution: JointSolution
    trials: dict[str, tuple[LensTrial, ...]]
    rays: dict[str, RayUncertainty]


def choose_lenses(rig: Rig, views: Sequence[LocatedView], solution: JointSolution) -> ChosenLenses:
    """Choose each camera's lens by its held-out boards, or by those of all cameras of its make.

    A lens that the rig file names stays.

    views: with points where the boards' corners really lie.
    """
    open_lens = {pair.name for pair in rig.pairs if pair.camera.lens == AUTO}
    candidates = {
        name: _Candidate.from_solution(name, views, solution)
        for name in sorted(solution.cameras)
        if solution.cameras[name].prior is None  # otherwise another program gave it
        and any(view.pair == name for view in views)
    }
    kinds = {
        name: FAMILY if name in open_lens and candidate.kind in FAMILY else (candidate.kind,)
        for name, candidate in candidates.items()
    }
    names = list(candidates)
    lenses = map_threads(
        lambda name: candidates[name].choose(kinds[name]), names, stage="choosing lenses"
    )
    chosen = dict(zip(names, lenses, strict=True))
    sizes = {name: (one.camera.width, one.camera.height) for name, one in candidates.items()}
    for size in sorted(set(sizes.values())):  # all that images show of which are of one make
        make = {name: lens for name, lens in chosen.items() if sizes[name] == size}
        chosen |= _pool_decentring(make, candidates, kinds)
    cameras = {
        name: lens.fit.camera
        for name, lens in chosen.items()
        if type(lens.fit.camera.lens) is not candidates[name].kind
    }
    return ChosenLenses(
        replace(solution, cameras=solution.cameras | cameras),
        {name: lens.trials for name, lens in chosen.items() if lens.trials},
        {name: lens.rays for name, lens in chosen.items()},
    )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A camera solved with the richest lens, its views and their `camera_from_board`."""

    camera: Camera
    poses: list[RigidTransform]
    views: list[PlanarView]

    @staticmethod
    def from_solution(
        name: str, views: Sequence[LocatedView], solution: JointSolution
    ) -> _Candidate:
        of_pair = [view for view in views if view.pair == name]
        camera_from_root = solution.root_from_camera[name].inverse()
        return _Candidate(
            solution.cameras[name],
            [camera_from_root @ solution.root_from_board[view.target] for view in of_pair],
            [PlanarView(view.shot, view.points, view.pixels) for view in of_pair],
        )

    @property
    def kind(self) -> type[Lens]:
        return type(self.camera.lens)

    def choose(self, kinds: Sequence[type[Lens]]) -> ChosenLens:
        return choose_lens(kinds, self.camera, self.poses, self.views)


def _pool_decentring(
    chosen: Mapping[str, ChosenLens],
    candidates: Mapping[str, _Candidate],
    kinds: Mapping[str, Sequence[type[Lens]]],
) -> dict[str, ChosenLens]:
    """Brown's lens in place of the chapter's, if the cameras together are decentred beyond chance.

    A camera's own boards must not clearly speak against it. A decentring too small for one camera to
    prove is not zero: left out, it hides in the principal point, whose sigma does not account for
    it. Held-out boards hardly see what hides so well; how many of its sigmas it is off zero does. The
    other terms of a rational lens hide nowhere.
    """
    open_ = [
        name
        for name, lens in chosen.items()
        if lens.fit.camera.lens.kind == Radial.kind
        and any(trial.kind == Brown.kind and trial.is_open for trial in lens.trials)
    ]
    decentring = np.array([_decentring(chosen[name]) for name in open_]).ravel()
    if not open_ or np.mean(decentring**2) < 1.0 + MIN_GAIN * np.sqrt(2.0 / len(decentring)):
        return {}
    found = {}
    for name in open_:
        again = candidates[name].choose(kinds[name][kinds[name].index(Brown) :])
        simple, brown = chosen[name].trials[:2]
        first = replace(brown, chosen=again.trials[0].chosen)
        trials = (replace(simple, chosen=False), first, *again.trials[1:])
        found[name] = replace(again, trials=trials)
    return found


def _decentring(lens: ChosenLens) -> Array:
    """p1 and p2 in their sigmas, (2,), of the fit with Brown's lens."""
    fit = next(fit for fit in lens.tried if type(fit.camera.lens) is Brown)
    columns = [fit.camera.parameter_names.index(name) for name in ("p1", "p2")]
    return np.asarray(fit.camera.parameters[columns] / np.sqrt(np.diag(fit.covariance)[columns]))
