"""RigidTransform by its laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calib.transform import RigidTransform

coordinates = st.lists(st.floats(-100, 100), min_size=3, max_size=3)


@st.composite
def transforms(draw, target="B", source="A"):
    turn = draw(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
    return RigidTransform(target, source, Rotation.from_rotvec(turn).as_matrix(), np.array(draw(coordinates)))


@given(transforms(), coordinates)
def test_inverse_undoes(transform, point):
    assert transform.inverse().apply(transform.apply(point)) == pytest.approx(point, abs=1e-9)


@given(transforms("C", "B"), transforms("B", "A"), coordinates)
def test_product_is_one_after_the_other(second, first, point):
    product = second @ first
    assert (product.target, product.source) == ("C", "A")
    assert product.apply(point) == pytest.approx(second.apply(first.apply(point)), abs=1e-9)


@given(transforms("D", "C"), transforms("C", "B"), transforms("B", "A"))
def test_product_is_associative(third, second, first):
    one, other = (third @ second) @ first, third @ (second @ first)
    assert one.rotation == pytest.approx(other.rotation, abs=1e-9)
    assert one.translation_mm == pytest.approx(other.translation_mm, abs=1e-9)


@given(transforms())
def test_identity_changes_nothing_and_inverse_of_inverse_is_the_same(transform):
    kept = RigidTransform.identity("B") @ transform @ RigidTransform.identity("A")
    for other in (kept, transform.inverse().inverse()):
        assert other.rotation == pytest.approx(transform.rotation, abs=1e-12)
        assert other.translation_mm == pytest.approx(transform.translation_mm, abs=1e-9)


@given(transforms(), coordinates, coordinates)
def test_distances_and_handedness_are_kept(transform, one, other):
    moved = transform.apply([one, other])
    assert np.linalg.norm(moved[0] - moved[1]) == pytest.approx(np.linalg.norm(np.subtract(one, other)), abs=1e-9)
    crossed = np.cross(transform.rotate(one), transform.rotate(other))
    assert transform.rotate(np.cross(one, other)) == pytest.approx(crossed, abs=1e-6)


def test_frames_must_meet():
    a = RigidTransform("B", "A", np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="frames do not meet: B <- A after B <- A"):
        _ = a @ a


@pytest.mark.parametrize(
    ("rotation", "translation", "reason"),
    [
        (np.diag([1.0, 1, -1]), np.zeros(3), "mirror"),
        (np.eye(3) * 1.001, np.zeros(3), "orthonormal"),
        (np.full((3, 3), np.nan), np.zeros(3), "finite"),
        (np.eye(3), np.array([0, np.inf, 0]), "finite"),
        (np.eye(4), np.zeros(3), "wanted"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(rotation, translation, reason):
    with pytest.raises(ValueError, match=reason):
        RigidTransform("B", "A", rotation, translation)


def test_its_arrays_are_its_own_and_fixed():
    rotation = np.eye(3)
    transform = RigidTransform("B", "A", rotation, np.zeros(3))
    rotation[0, 0] = 5.0
    assert transform.rotation[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        transform.rotation[0, 0] = 2.0
