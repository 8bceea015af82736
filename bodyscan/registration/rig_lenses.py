"""Each camera's lens in a rig of several: chosen after all were solved with the richest.

So no view is thought wrong because a lens was too simple, and boards that turned out bent try the
lenses in the shape they have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import LensTrial
from bodyscan.calibration.lens_choice import choose_lens
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import family_up_to
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


def choose_lenses(
    rig: Rig, views: Sequence[LocatedView], solution: JointSolution
) -> tuple[JointSolution, dict[str, tuple[LensTrial, ...]]]:
    """The solution with the lenses that each camera's own held-out boards choose, and how each lens
    did; cameras whose lens the rig file names stay as they are.

    views: their points where the boards' corners really lie.
    """
    cameras, trials = dict(solution.cameras), {}
    for name in _undecided(rig, cameras):
        own = [view for view in views if view.pair == name]
        camera_from_root = solution.root_from_camera[name].inverse()
        chosen = choose_lens(
            cameras[name],
            [camera_from_root @ solution.root_from_board[view.target] for view in own],
            [PlanarView(view.shot, view.points, view.pixels) for view in own],
        )
        trials[name] = chosen.trials
        if chosen.fit.camera.lens.kind != cameras[name].lens.kind:
            cameras[name] = chosen.fit.camera
    return replace(solution, cameras=cameras), trials


def _undecided(rig: Rig, cameras: Mapping[str, Camera]) -> list[str]:
    """Pairs whose lens nobody has told, and for which there is a simpler one."""
    left_open = {pair.name for pair in rig.pairs if pair.camera.lens == AUTO}
    return sorted(
        name
        for name, camera in cameras.items()
        if name in left_open and camera.prior is None and len(family_up_to(type(camera.lens))) > 1
    )
