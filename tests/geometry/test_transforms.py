import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bodyscan.arrays import Array
from bodyscan.geometry.transforms import (
    RigidTransform,
    adjoint,
    fit_rigid_transform,
    make_cross_matrix,
)

vectors = arrays(float, 3, elements=st.floats(-3.0, 3.0))
lengths = arrays(float, 3, elements=st.floats(-2000.0, 2000.0))
transforms = st.builds(RigidTransform.from_rotation_vector, vectors, lengths)


@given(transforms, arrays(float, (5, 3), elements=st.floats(-2000.0, 2000.0)))
def test_inverse_undoes(a_from_b: RigidTransform, points: Array) -> None:
    # 1e-9 mm: a thousand times the rounding of coordinates of a few metres.
    assert np.allclose(a_from_b.inverse().apply(a_from_b.apply(points)), points, atol=1e-9)


@given(transforms, transforms, lengths)
def test_composition_applies_right_to_left(
    a_from_b: RigidTransform, b_from_c: RigidTransform, point: Array
) -> None:
    composed = (a_from_b @ b_from_c).apply(point)
    assert np.allclose(composed, a_from_b.apply(b_from_c.apply(point)), atol=1e-9)


@given(transforms)
def test_matrix_round_trip(a_from_b: RigidTransform) -> None:
    again = RigidTransform.from_matrix(a_from_b.matrix)
    assert np.allclose(again.matrix, a_from_b.matrix, atol=1e-12)


@given(transforms, vectors, vectors)
def test_adjoint_carries_small_motions(a_from_b: RigidTransform, turn: Array, shift: Array) -> None:
    twist = 1e-6 * np.concatenate([turn, shift])
    in_b = a_from_b @ RigidTransform.identity().retract(twist)
    in_a = RigidTransform.identity().retract(adjoint(a_from_b) @ twist) @ a_from_b
    # The two agree to first order; the second-order term is (1e-6)^2 times metres.
    assert np.allclose(in_b.matrix, in_a.matrix, atol=1e-7)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: Array, b: Array) -> None:
    assert np.allclose(make_cross_matrix(a) @ b, np.cross(a, b))


@given(transforms, st.integers(0, 2**32 - 1))
def test_rigid_fit_recovers_the_transform(a_from_b: RigidTransform, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-500.0, 500.0, (12, 3))
    found = fit_rigid_transform(points, a_from_b.apply(points))
    assert np.allclose(found.matrix, a_from_b.matrix, atol=1e-9)
