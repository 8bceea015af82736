"""Cameras of every lens that there is, for Hypothesis."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import LENSES
from bodyscan.geometry.lenses.lens import Lens

# The least and longest lenses that scanners have: 35 and 12 degrees from the axis to the corner.
FOCAL_PX = st.floats(600.0, 2000.0)
SHARE = 0.2  # of the prior's sigma: a stronger lens may fold within the image


@st.composite
def lenses(draw: st.DrawFn) -> Lens:
    lens = LENSES[draw(st.sampled_from(sorted(LENSES)))]()
    count = len(lens.names)
    shares = draw(st.lists(st.floats(-SHARE, SHARE), min_size=count, max_size=count))
    return lens.with_coefficients(np.array(shares) * lens.prior_sigmas)


cameras = st.builds(
    Camera,
    alpha=FOCAL_PX,
    beta=FOCAL_PX,
    gamma=st.floats(-3.0, 3.0),
    u0=st.floats(300.0, 340.0),
    v0=st.floats(220.0, 260.0),
    lens=lenses(),
    width=st.just(640),
    height=st.just(480),
)


def pixels_of(camera: Camera) -> Array:
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 7))
    return np.stack([u, v], axis=-1).reshape(-1, 2)
