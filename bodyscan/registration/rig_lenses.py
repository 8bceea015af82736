"""The lens of each camera in a rig of several, chosen after all were solved with the richest one.

So no view is thought wrong because a lens was too simple, and boards found to be bent test the
lenses in their true shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import LensTrial
from bodyscan.calibration.held_out import CLEARLY
from bodyscan.calibration.lens_choice import ChosenLens, choose_lens
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import family_up_to
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.ray_uncertainty import RayUncertainty
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import threaded
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
        if chosen.chosen and chosen.gain is not None and chosen.gain >= CLEARLY
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
    """Choose each camera's lens by its own held-out boards.

    A lens that the rig file names stays.

    views: with points where the boards' corners really lie.
    """
    open_lens = {pair.name for pair in rig.pairs if pair.camera.lens == AUTO}
    looked = {
        name: _Looked.of(name, views, solution)
        for name in sorted(solution.cameras)
        if solution.cameras[name].prior is None  # otherwise another program gave it
        and any(view.pair == name for view in views)
    }
    kinds = {
        name: family_up_to(own.kind) if name in open_lens else (own.kind,)
        for name, own in looked.items()
    }
    names = list(looked)
    own = threaded(lambda name: looked[name].choose(kinds[name]), names, stage="choosing lenses")
    chosen = dict(zip(names, own, strict=True))
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
    """A camera solved with the richest lens, its views and their `camera_from_board`."""

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
