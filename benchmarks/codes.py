"""Every code on the same scenes: a board, and a hollow with a shadow in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.rig.frame_names import FrameNames
from bodyscan.rig.rig import load_rig
from bodyscan.simulation.board import make_board
from bodyscan.simulation.files import scale_rig
from bodyscan.simulation.lamps import Lamps
from bodyscan.simulation.layout import TruePair, build_pairs
from bodyscan.simulation.patterns import simulate_instrument
from bodyscan.simulation.rays import View
from bodyscan.simulation.render import PixelTruth, compute_pixel_truth, render_pair
from bodyscan.simulation.scene import Scene, build_grid_surface
from bodyscan.simulation.sensor import choose_exposure, expose
from bodyscan.simulation.settings import SimulationSettings
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_code import StripeCode

RIG = Path(__file__).parents[1] / "rigs" / "one-pair.yaml"
SEED = 7
SKIN = 0.75
IN_HOLLOW = [
    "Gray, inverses",
    "Gray",
    "binary, inverses",
    "light section",
    "phase shift, 4 steps of 8 stripes",
    "phase shift, 4 steps of 4 stripes",
]
CODES: dict[str, dict[str, object]] = {
    "Gray, inverses": {},
    "Gray": {"inverses": False},
    "binary, inverses": {"code": "binary"},
    "binary": {"code": "binary", "inverses": False},
    "light section": {"code": "light-section"},
    "stripe index": {"code": "stripe-index"},
    "phase shift, 4 steps of 8 stripes": {"code": "phase-shift", "steps": 4, "period": 8},
    "phase shift, 8 steps of 8 stripes": {"code": "phase-shift", "steps": 8, "period": 8},
    "phase shift, 4 steps of 4 stripes": {"code": "phase-shift", "steps": 4, "period": 4},
    "phase shift, 4 steps of 16 stripes": {"code": "phase-shift", "steps": 4, "period": 16},
}


def report() -> str:
    """The section of docs/results.md."""
    settings = SimulationSettings()
    rig = scale_rig(load_rig(RIG), 0.5, "captures")
    (pair,) = build_pairs(rig, settings, lambda _: np.random.default_rng(SEED)).values()
    projector = rig.pairs[0].projector
    assert projector is not None
    groups = (
        ("a board", _board(rig.boards[0], settings), settings, list(CODES)),
        ("a hollow", hollow(), settings, IN_HOLLOW),
    )
    rows = []
    for group, scene, chosen, names in groups:
        truth = compute_pixel_truth(scene, pair.camera, pair.projector)
        rows.append(f"| **{group}** | | | | | | | |")
        for name in names:
            same = {"stripes": projector.stripes, "direction": projector.direction}
            spec = parse_stripe_code({**same, **CODES[name]})
            rows.append(f"| {name} | {_row(spec, scene, pair, truth, chosen)} |")
    return f"""## Every code on one scene

`python -m benchmarks codes`: {rig.pairs[0].camera.width} x {rig.pairs[0].camera.height} px,
{projector.stripes} stripes of about 2 px, one scene after the other, the simulator's usual light and
noise. The hollow is a groove of 70 degrees with a bar before it that throws a shadow into it, of
albedo 0.75. Errors of s against truth at pixel centres, in stripes; "sigmas": the errors'
robust scale over the decoder's sigma (1 would be perfect); "false": pixels with s that the
projector does not light, over those that it does.

| code | images | pixels with s | median | RMS | 99 % | sigmas | false |
|---|---|---|---|---|---|---|---|
{chr(10).join(rows)}
"""


def hollow() -> Scene:
    """A groove 110 mm deep, 400 mm away, and a 14 mm bar in front of its middle; camera frame."""
    down, crease = np.array([0.0, 140.0, 0.0]), np.array([-10.0, -70.0, 400.0])
    sides = [110.0 * np.array([np.sin(turn), 0.0, -np.cos(turn)]) for turn in np.radians([-35, 35])]
    bar = build_grid_surface(
        np.array([-6.0, -70.0, 320.0]), np.array([14.0, 0.0, 0.0]), down, albedo=SKIN
    )
    return Scene([bar, *(build_grid_surface(crease, side, down, albedo=SKIN) for side in sides)])


def _board(board: Board, settings: SimulationSettings) -> Scene:
    made = make_board(board, settings.board, np.random.default_rng(SEED))
    turned = RigidTransform.from_rotation_vector([0.25, -0.2, 0.1], [-85.0, -65.0, 340.0])
    return Scene([surface.transform(turned) for surface in made.surfaces])


def _row(
    spec: StripeCode, scene: Scene, pair: TruePair, truth: PixelTruth, settings: SimulationSettings
) -> str:
    rng, frames = np.random.default_rng(SEED), FrameNames()
    view = View.from_camera(pair.camera, settings.optics, rng)
    light = settings.lighting
    lamps = Lamps(light.laser_grey, light.ambient_grey, 0.85 * pair.reach_mm, pair.reach_mm)
    images = render_pair(
        scene, view, pair.projector, lamps, settings.projection, rng, frames=frames, code=spec
    )
    length = choose_exposure(images["lit"], light.board_grey, light)
    seen = {name: expose(image * length, settings.noise, rng) for name, image in images.items()}
    if not spec.is_projected:
        seen = simulate_instrument(seen, spec, frames)
    coded = np.stack([seen[name] for name in frames.code_names(spec)])
    found = decode_stripes(spec, seen["lit"], seen.get(frames.dark or ""), coded)
    lit = np.isfinite(truth.s)
    known = lit & np.isfinite(found.s)
    error = np.abs(found.s - truth.s)[known]
    spread = np.median(error / found.sigma[known]) / 0.6745
    rms, most = np.sqrt(np.mean(error**2)), np.percentile(error, 99)
    false = np.isfinite(found.s[~lit]).sum() / lit.sum()
    return (
        f"{len(seen)} | {known.sum() / lit.sum():.1%} | {np.median(error):.4f} | {rms:.4f} | "
        f"{most:.3f} | {spread:.2f} | {false:.2%}"
    )
