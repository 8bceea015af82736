"""Each camera's lens in a rig of several: chosen after all were solved with the richest.

So no view is thought wrong because a lens was too simple, and boards that turned out bent try the
lenses in the shape they have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import LensTrial
from bodyscan.calibration.lens_choice import choose_lens
from bodyscan.geometry.lenses import family_up_to
from bodyscan.geometry.ray_uncertainty import RayUncertainty
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.rig.pair import AUTO
from bodyscan.rig.rig import Rig


def lens_notes(trials: Mapping[str, Sequence[LensTrial]]) -> list[str]:
    """A line for each camera that the chapter's lens does not describe."""
    return [
        f"{name}: lens {chosen.kind}, by {chosen.gain:.0f} standard errors: boards held out fit to "
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
    """Each camera's own held-out boards choose its lens; one that the rig file names stays.

    views: their points where the boards' corners really lie.
    """
    cameras = dict(solution.cameras)
    trials: dict[str, tuple[LensTrial, ...]] = {}
    rays: dict[str, RayUncertainty] = {}
    open_lens = {pair.name for pair in rig.pairs if pair.camera.lens == AUTO}
    for name in sorted(cameras):
        own = [view for view in views if view.pair == name]
        if not own or cameras[name].prior is not None:
            continue  # another program knew it
        camera_from_root = solution.root_from_camera[name].inverse()
        kind = type(cameras[name].lens)
        chosen = choose_lens(
            family_up_to(kind) if name in open_lens else (kind,),
            cameras[name],
            [camera_from_root @ solution.root_from_board[view.target] for view in own],
            [PlanarView(view.shot, view.points, view.pixels) for view in own],
        )
        rays[name] = chosen.rays
        if chosen.trials:
            trials[name] = chosen.trials
        if type(chosen.fit.camera.lens) is not kind:
            cameras[name] = chosen.fit.camera
    return ChosenLenses(replace(solution, cameras=cameras), trials, rays)
