"""Head and arms as wholes of their own, on cells laid out by hand."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from bodyscan.alignment.body_cells import BodyCells
from bodyscan.alignment.limbs import LIMBS, limb_fields


def person() -> BodyCells:
    """A post with a bar across at the shoulders, one cell every 30 mm, all facing x."""
    post = [[0.0, 0.0, z] for z in np.arange(15.0, 1700.0, 30.0)]
    bar = [[0.0, y, 1365.0] for y in np.arange(-780.0, 781.0, 30.0) if y]
    centres = np.array(post + bar)
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    links = sparse.csr_array(np.where(apart < 31.0, apart, 0.0))
    landmarks = np.arange(len(centres))
    normals = np.tile([1.0, 0.0, 0.0], (len(centres), 1))
    bare = BodyCells(centres, normals, links, landmarks, np.empty((0, 0)))
    return BodyCells(centres, normals, links, landmarks, bare.distances(landmarks))


def test_each_turns_about_its_own_middle_and_nothing_else_goes_along() -> None:
    cells = person()
    fields = limb_fields(cells, 400.0)
    assert tuple(fields) == LIMBS
    hand = int(np.argmax(cells.centres[:, 1]))
    other, foot = int(np.argmin(cells.centres[:, 1])), int(np.argmin(cells.centres[:, 2]))
    left = fields["left arm"]
    # Six motions, the last three of which shift all of the arm by 1 mm.
    np.testing.assert_allclose(left[hand, :3, 3:], np.eye(3), atol=1e-3)
    np.testing.assert_allclose(left[[other, foot], :3], 0.0, atol=1e-3)
    np.testing.assert_allclose(fields["right arm"][other, :3, 3:], np.eye(3), atol=1e-3)
    # A turn about z carries a hand backwards or forwards by its distance from the arm's middle / 400.
    assert 0.3 < abs(left[hand, 0, 2]) < 1.0
    np.testing.assert_allclose(left[hand, 1, 2], 0.0, atol=1e-3)


def test_what_the_body_does_not_show_moves_nothing() -> None:
    cells = person()
    legs = cells.centres * [1.0, 1.0, 0.0] + [0.0, 0.0, 100.0]
    legs[0, 2] = 1000.0
    low = BodyCells(legs, cells.normals, cells.links, cells.landmarks, cells.away)
    assert np.abs(limb_fields(low, 400.0)["left arm"][1:]).max() < 1.0 + 1e-9
