"""The lens of each camera in a rig of several, chosen after all were solved with the richest one.

So no view is thought wrong because a lens was too simple, and boards found to be bent test the
lenses in their true shape. Cameras of a rig are usually of one make: what none can prove alone, all
may prove together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.lens_selection import ChosenLens, LensTrial, choose_lens
from bodyscan.calibration.model_selection import MIN_GAIN
from bodyscan.geometry.lenses import FAMILY
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Radial
from bodyscan.geometry.uncertainty import RayUncertainty
from bodyscan.progress import map_threads
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.rig.pair import AUTO
from bodyscan.rig.rig import Rig


@dataclass(frozen=True, eq=False)
class ChosenLenses:
    """The solution with the chosen lenses."""

    solution: JointSolution
    trials: dict[str, tuple[LensTrial, ...]]  # by camera whose lens was open, how each lens did
    # By camera, how well the corners determine each pixel's ray if they err independently.
    rays: dict[str, RayUncertainty]


def choose_lenses(rig: Rig, views: Sequence[LocatedView], solution: JointSolution) -> ChosenLenses:
    """Choose each camera's lens by its held-out boards, or by those of all cameras of its make.

    A lens that the rig file names stays.

    views: with points where the boards' corners really lie.
    """
    open_lens = {pair.name for pair in rig.pairs if pair.camera.lens == AUTO}
    cameras = {
        name: solution.cameras[name]
        for name in sorted({view.pair for view in views})
        if solution.cameras[name].prior is None  # otherwise another program gave it
    }
    kinds: dict[str, tuple[type[Lens], ...]] = {
        name: FAMILY if name in open_lens and type(camera.lens) in FAMILY else (type(camera.lens),)
        for name, camera in cameras.items()
    }

    def choose(name: str, tried: Sequence[type[Lens]]) -> ChosenLens:
        of_pair = [view for view in views if view.pair == name]
        camera_from_root = solution.root_from_camera[name].inverse()
        poses = [camera_from_root @ solution.root_from_board[view.target] for view in of_pair]
        planar = [PlanarView(view.shot, view.points, view.pixels) for view in of_pair]
        return choose_lens(tried, cameras[name], poses, planar)

    lenses = map_threads(lambda name: choose(name, kinds[name]), kinds)
    chosen = dict(zip(kinds, lenses, strict=True))
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    for size in sorted(set(sizes.values())):  # all that images show of which are of one make
        make = {name: lens for name, lens in chosen.items() if sizes[name] == size}
        for name in _find_decentred(make):
            chosen[name] = _begin_with_brown(chosen[name], partial(choose, name), kinds[name])
    changed = {
        name: lens.fit.camera
        for name, lens in chosen.items()
        if type(lens.fit.camera.lens) is not type(cameras[name].lens)
    }
    return ChosenLenses(
        replace(solution, cameras=solution.cameras | changed),
        {name: lens.trials for name, lens in chosen.items() if lens.trials},
        {name: lens.rays for name, lens in chosen.items()},
    )


def _find_decentred(chosen: Mapping[str, ChosenLens]) -> list[str]:
    """Cameras of one make that get Brown's lens in place of the chapter's, if together they are
    decentred beyond chance.

    A camera's own boards must speak clearly neither for nor against it. A decentring too small for one
    camera to prove hides in the principal point, whose sigma does not account for it, and hardly shows
    on held-out boards; how many of its sigmas it is off zero does. A rational lens's others hide
    nowhere.
    """
    open_ = [
        name
        for name, lens in chosen.items()
        if lens.fit.camera.lens.kind in (Radial.kind, Brown.kind)
        and any(trial.kind == Brown.kind and trial.is_open for trial in lens.trials)
    ]
    decentring = np.array([_measure_decentring(chosen[name]) for name in open_]).ravel()
    if not open_ or np.mean(decentring**2) < 1.0 + MIN_GAIN * np.sqrt(2.0 / len(decentring)):
        return []
    return [name for name in open_ if chosen[name].fit.camera.lens.kind == Radial.kind]


def _begin_with_brown(
    lens: ChosenLens,
    choose: Callable[[Sequence[type[Lens]]], ChosenLens],
    kinds: Sequence[type[Lens]],
) -> ChosenLens:
    """Choose again, with Brown's lens as the simplest."""
    again, (simple, brown) = choose(kinds[kinds.index(Brown) :]), lens.trials[:2]
    first = replace(brown, chosen=again.trials[0].chosen)
    return replace(again, trials=(replace(simple, chosen=False), first, *again.trials[1:]))


def _measure_decentring(lens: ChosenLens) -> Array:
    """p1 and p2 in their sigmas, (2,), of the fit with Brown's lens."""
    fit = next(fit for fit in lens.tried if type(fit.camera.lens) is Brown)
    columns = [fit.camera.parameter_names.index(name) for name in ("p1", "p2")]
    return np.asarray(fit.camera.parameters[columns] / np.sqrt(np.diag(fit.covariance)[columns]))
