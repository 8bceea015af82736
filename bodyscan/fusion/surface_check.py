"""Compare the mesh with the range images: what was measured, and what each pair should have seen.

The cloud is thinned to a requested number of points; what was measured does not depend on that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.topology import face_normals
from bodyscan.reconstruction.range_image import RangeImage

SPOTS = 20_000
REACH_MM = 10.0
"""A mesh of few points may be this far off what was measured; webs and soles are farther off."""
FACING = 0.5
"""Least cosine at which a camera that looks at skin should measure it, 60 degrees."""
FEWEST_SPOTS = 50
WHITE = 254


@dataclass(frozen=True, eq=False)
class SurfaceCheck:
    """A sample of the mesh's faces, and how much each pair measured.

    heights_mm: heights of the faces, (N,).
    areas_mm2: areas that they stand for, (N,).
    filled: whether nobody measured them, (N,).
    yields: by pair, share of the faces that it looks at and others measured, at which it measured
        anything; pairs that look at next to nothing are left out.
    saturated: by pair, share of those faces that are white in its lit image.
    """

    heights_mm: Array
    areas_mm2: Array
    filled: Mask
    yields: Mapping[str, float]
    saturated: Mapping[str, float]

    @property
    def filled_share(self) -> float:
        return float(self.areas_mm2[self.filled].sum() / max(self.areas_mm2.sum(), 1e-12))


def check_surface(
    mesh: BodyMesh, images: Sequence[RangeImage], rig_from_camera: Mapping[str, RigidTransform]
) -> SurfaceCheck:
    """Compare the mesh with range images: cleaned, of all pairs that gave some."""
    some = slice(None, None, max(1, len(mesh.faces) // SPOTS))
    places = mesh.vertices[mesh.faces[some]].mean(axis=1)
    across = face_normals(mesh.vertices, mesh.faces[some])
    doubled = np.linalg.norm(across, axis=1)
    normals = across / np.maximum(doubled[:, None], 1e-12)
    looks = [_Look.at(places, normals, image, rig_from_camera[image.pair]) for image in images]
    count = np.sum([look.measured for look in looks], axis=0)
    yields, saturated = {}, {}
    for image, look in zip(images, looks, strict=True):
        # What a pair alone says about itself is not evidence.
        asked = look.faces & (count - look.measured > 0)
        if np.count_nonzero(asked) >= FEWEST_SPOTS:
            yields[image.pair] = float(np.mean(look.shown[asked]))
            saturated[image.pair] = float(np.mean(look.white[asked]))
    return SurfaceCheck(places[:, 2], 0.5 * doubled, count == 0, yields, saturated)


@dataclass(frozen=True, eq=False)
class _Look:
    """One camera's view of N spots.

    faces: spots that face it inside its image.
    shown: spots at whose pixel it measured something.
    measured: spots that it measured themselves.
    white: spots that are white in its lit image.
    """

    faces: Mask
    shown: Mask
    measured: Mask
    white: Mask

    @staticmethod
    def at(places: Array, normals: Array, image: RangeImage, at: RigidTransform) -> _Look:
        camera_from_rig = at.inverse()
        seen, turned = camera_from_rig.apply(places), camera_from_rig.rotate(normals)
        ahead = seen[:, 2] > 1.0
        u, v = image.camera.project(np.where(ahead[:, None], seen, 1.0)).T
        inside = ahead & (u > -0.5) & (v > -0.5)
        inside &= (u < image.camera.width - 0.5) & (v < image.camera.height - 0.5)
        column = np.where(inside, np.rint(u), 0).astype(np.intp)
        row = np.where(inside, np.rint(v), 0).astype(np.intp)
        facing = -np.sum(seen * turned, axis=1) > FACING * np.linalg.norm(seen, axis=1)
        own = np.stack([row, column], axis=-1) - image.corner
        kept = inside & ((own >= 0) & (own < image.sigma_mm.shape)).all(axis=1)
        here = tuple(np.where(kept[:, None], own, 0).T)
        shown = kept & image.valid[here]
        apart = np.abs(np.sum((image.points[here] - seen) * turned, axis=1))
        white = inside & (image.lit[row, column] >= WHITE)
        return _Look(inside & facing, shown, shown & (apart < REACH_MM), white)
