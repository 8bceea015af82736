"""PLY as bodyscan itself stores bodies: exact, with everything known about them."""

from __future__ import annotations

from bodyscan.export.formats import BodyFormat
from bodyscan.mesh.ply import write_ply

FORMAT = BodyFormat(
    write_ply,
    holds=frozenset({"mesh", "cloud", "colours", "normals", "sigma", "filled", "regions"}),
    free_axes=True,
)
