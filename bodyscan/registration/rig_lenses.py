"""Each camera's lens in a rig of several: chosen after all were solved with the richest.

So no view is thought wrong because a lens was too simple, and boards that turned out bent try the
lenses in the shape they have.  Cameras of a rig are as a rule of one make: what none can prove by
itself all may together.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import LensTrial
from bodyscan.calibration.held_out import CLEARLY
from bodyscan.calibration.lens_choice import ChosenLens, choose_lens
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import family_up_to
from bodyscan.geometry.lenses.brown import Brown
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.ray_uncertainty import RayUncertainty
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import threaded
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.rig.pair import AUTO
from bodyscan.rig.rig import Rig


def lens_notes(trials: Mapping[str, Sequence[LensTrial]]) -> list[str]:
    """A line for each camera that the chapter's lens does not describe."""
    return [
        f"{name}: lens {chosen.kind}, by {chosen.gain:.0f} standard errors"
        f"{'' if chosen.gain >= CLEARLY else ', as cameras of its make'}: boards held out fit to "
        f"{chosen.rms_px:.3f} px with it, {tried[0].rms_px:.3f} with {tried[0].kind}"
        for name, tried in trials.items()
        for chosen in tried
        if chosen.chosen and chosen.gain is not None
    ]


@dataclass(frozen=True, eq=False)
class ChosenLenses:
    """The solution with the lenses chosen; by camera, how each lens did where its lens was open, and
    how well each pixel's ray is known by the corners, if those err independently."""

    solution: JointSolution
    trials: dict[str, tuple[LensTrial, ...]]
    rays: dict[str, RayUncertainty]


def choose_lenses(rig: Rig, views: Sequence[LocatedView], solution: JointSolution) -> ChosenLenses:
    """Held-out boards choose each camera's lens, its own or those of all cameras of its make
    together; one that the rig file names stays.

    views: their points where the boards' corners really lie.
    """
    open_lens = {pair.name for pair in rig.pairs if pair.camera.lens == AUTO}
    looked = {
        name: _Looked.of(name, views, solution)
        for name in sorted(solution.cameras)
        if solution.cameras[name].prior is None  # or another program knew it
        and any(view.pair == name for view in views)
    }
    kinds = {
        name: family_up_to(own.kind) if name in open_lens else (own.kind,)
        for name, own in looked.items()
    }
    names = list(looked)
    own = threaded(lambda name: looked[name].choose(kinds[name]), names, stage="choosing lenses")
    chosen = dict(zip(names, own, strict=True))
    for alike in _of_one_make(looked):
        chosen |= _choose_together({name: chosen[name] for name in alike}, looked, kinds)
    cameras = {
        name: lens.fit.camera
        for name, lens in chosen.items()
        if type(lens.fit.camera.lens) is not looked[name].kind
    }
    return ChosenLenses(
        replace(solution, cameras=solution.cameras | cameras),
        {name: lens.trials for name, lens in chosen.items() if lens.trials},
        {name: lens.rays for name, lens in chosen.items()},
    )


@dataclass(frozen=True, eq=False)
class _Looked:
    """A camera, solved with the richest lens, and what it saw: poses `camera_from_board`."""

    camera: Camera
    poses: list[RigidTransform]
    views: list[PlanarView]

    @staticmethod
    def of(name: str, views: Sequence[LocatedView], solution: JointSolution) -> _Looked:
        own = [view for view in views if view.pair == name]
        camera_from_root = solution.root_from_camera[name].inverse()
        return _Looked(
            solution.cameras[name],
            [camera_from_root @ solution.root_from_board[view.target] for view in own],
            [PlanarView(view.shot, view.points, view.pixels) for view in own],
        )

    @property
    def kind(self) -> type[Lens]:
        return type(self.camera.lens)

    def choose(self, kinds: Sequence[type[Lens]]) -> ChosenLens:
        return choose_lens(kinds, self.camera, self.poses, self.views)


def _of_one_make(looked: Mapping[str, _Looked]) -> Iterator[list[str]]:
    """Cameras whose pictures are of one size, as far as images tell what is of one make."""
    size = {name: (own.camera.width, own.camera.height) for name, own in looked.items()}
    for one in sorted(set(size.values())):
        yield [name for name in looked if size[name] == one]


def _choose_together(
    chosen: Mapping[str, ChosenLens],
    looked: Mapping[str, _Looked],
    kinds: Mapping[str, Sequence[type[Lens]]],
) -> dict[str, ChosenLens]:
    """The lenses, Brown's in place of the chapter's where all cameras together call for it and a
    camera's own boards do not speak against it.

    A decentring too small for one camera to prove is not zero: left out, it hides in the principal
    point, whose sigma knows nothing of it.  What a rational lens has besides hides nowhere.
    """
    found = dict(chosen)
    said = {name: _gain(lens, Brown) for name, lens in found.items()}
    known = [min(gain, CLEARLY) for gain in said.values() if gain is not None]
    if sum(known) < CLEARLY * np.sqrt(max(len(known), 1)):
        return found
    for name, gain in said.items():
        if gain is not None and 0.0 < gain < CLEARLY:
            own = kinds[name]
            again = looked[name].choose(own[own.index(Brown) :])
            trials = _with_what_followed(found[name].trials, again)
            found[name] = replace(again, trials=trials)
    return found


def _gain(lens: ChosenLens, kind: type[Lens]) -> float | None:
    """By how many standard errors this camera's own boards call for such a lens; None if not tried."""
    return next((trial.gain for trial in lens.trials if trial.kind == kind.kind), None)


def _with_what_followed(trials: Sequence[LensTrial], again: ChosenLens) -> tuple[LensTrial, ...]:
    """Trials of which the last refused a lens, when it was taken after all and richer ones tried."""
    *before, refused = trials
    taken = replace(refused, chosen=again.fit.camera.lens.kind == refused.kind)
    return (*(replace(trial, chosen=False) for trial in before), taken, *again.trials[1:])
