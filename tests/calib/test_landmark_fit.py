"""The rigid landmark fit against two independent ones, and what it refuses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonTransforms import vtkLandmarkTransform

from calib.landmark import fit_rigid, spread_mm
from drivers.errors import CalibrationError


def vtk_matrix(source, target, *, rigid):
    """(4, 4) of VTK's landmark transform; its default mode where not ``rigid``."""
    transform = vtkLandmarkTransform()
    for points, setter in ((source, transform.SetSourceLandmarks), (target, transform.SetTargetLandmarks)):
        landmarks = vtkPoints()
        landmarks.SetDataTypeToDouble()
        for point in points:
            landmarks.InsertNextPoint(point)
        setter(landmarks)
    if rigid:
        transform.SetModeToRigidBody()
    transform.Update()
    matrix = transform.GetMatrix()
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def horn_rotation(source, target):
    """Horn 1987: the unit quaternion is the eigenvector of the largest eigenvalue."""
    M = (source - source.mean(axis=0)).T @ (target - target.mean(axis=0))
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = M
    N = np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, -xx + yy - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, -xx - yy + zz],
        ]
    )
    w, x, y, z = np.linalg.eigh(N)[1][:, -1]
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def noisy_pair(seed, n=8, noise_mm=0.2, spread=(5.0, 10.0, 4.0)):
    rng = np.random.default_rng(seed)
    source = rng.uniform(-1, 1, (n, 3)) * spread
    rotation = Rotation.random(rng=rng).as_matrix()
    return source, source @ rotation.T + rng.uniform(-20, 20, 3) + rng.normal(0, noise_mm, (n, 3)), rotation


def fit(source, target):
    return fit_rigid(source, target, source="Mi", target="R")


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(4, 20))
def test_agrees_with_vtk_in_its_rigid_mode_and_with_horn(seed, n):
    source, target, _ = noisy_pair(seed, n)
    ours = fit(source, target).transform
    vtk = vtk_matrix(source, target, rigid=True)
    assert ours.rotation == pytest.approx(vtk[:3, :3], abs=1e-6)
    assert ours.translation_mm == pytest.approx(vtk[:3, 3], abs=1e-5)
    assert ours.rotation == pytest.approx(horn_rotation(source, target), abs=1e-9)


def test_erratum_12_the_default_mode_of_vtk_scales_and_ours_never_does():
    source, target, _ = noisy_pair(1, noise_mm=0.0)
    target = target * 1.03
    scaled = vtk_matrix(source, target, rigid=False)[:3, :3]
    assert np.linalg.norm(scaled[0]) == pytest.approx(1.03, abs=1e-6)
    ours = fit(source, target)
    assert ours.transform.rotation == pytest.approx(vtk_matrix(source, target, rigid=True)[:3, :3], abs=1e-6)
    assert ours.rmse_mm == pytest.approx(0.03 * np.sqrt((spread_mm(source) ** 2).sum()), rel=1e-6)


def test_recovers_an_exact_transform_and_reports_no_residual():
    source, target, rotation = noisy_pair(2, noise_mm=0.0)
    found = fit(source, target)
    assert found.transform.rotation == pytest.approx(rotation, abs=1e-9)
    assert (found.transform.target, found.transform.source) == ("R", "Mi")
    assert found.rmse_mm < 1e-9
    assert found.leave_one_out_mm.max() < 1e-9
    assert found.handedness == "right-handed"


def test_leave_one_out_is_the_error_of_the_others_fit():
    source, target, _ = noisy_pair(3)
    found = fit(source, target)
    others = fit(source[1:], target[1:])
    expected = np.linalg.norm(target[0] - others.transform.apply(source[0]))
    assert found.leave_one_out_mm[0] == pytest.approx(expected, rel=1e-9)
    assert (found.leave_one_out_mm > np.linalg.norm(found.residuals_mm, axis=1)).all()


def test_the_covariance_is_what_repeated_noise_shows():
    rng = np.random.default_rng(4)
    source, clean, _ = noisy_pair(4, noise_mm=0.0)
    center = clean.mean(axis=0)
    truth = fit(source, clean).transform
    per_point = np.diag([0.02, 0.02, 0.2]) ** 2
    changes = []
    for _ in range(500):
        noisy = source + rng.multivariate_normal(np.zeros(3), per_point, len(source))
        found = fit_rigid(noisy, clean, source="Mi", target="R").transform
        turn = Rotation.from_matrix(found.rotation @ truth.rotation.T).as_rotvec()
        changes.append(np.concatenate([turn, found.apply(truth.inverse().apply(center)) - center]))
    predicted = fit(source, clean).covariance_for(per_point)
    assert np.sqrt(np.var(changes, axis=0)) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.12)


def test_covariance_without_a_prior_comes_from_the_residuals():
    source, target, _ = noisy_pair(5, n=200, noise_mm=0.2)
    assert np.sqrt(np.diag(fit(source, target).covariance))[3:] == pytest.approx(0.2 / np.sqrt(200), rel=0.15)


def test_condition_grows_as_the_points_near_a_line():
    wide, narrow = (fit(*noisy_pair(6, spread=(10.0, width, 3.0))[:2]) for width in (10.0, 2.0))
    assert narrow.condition > 2 * wide.condition


def test_fewer_than_three_points_are_refused():
    with pytest.raises(CalibrationError, match="2 points; at least 3"):
        fit(np.zeros((2, 3)), np.zeros((2, 3)))


@pytest.mark.parametrize("side", ["source", "target"])
def test_collinear_points_are_refused(side):
    line = np.outer(np.arange(5.0), [1, 2, 3])
    bent = line + np.array([[0, 0, 0], [3, 0, 0], [0, 0, 0], [0, 5, 0], [0, 0, 9]])
    with pytest.raises(CalibrationError, match=r"one line.*add a point"):
        fit(line, bent) if side == "source" else fit(bent, line)


def test_points_that_are_not_finite_are_refused():
    source, target, _ = noisy_pair(7)
    target[3, 1] = np.nan
    with pytest.raises(CalibrationError, match="not finite"):
        fit(source, target)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("noise_mm", [0.0, 0.3])
def test_erratum_3_a_mirrored_frame_is_refused_by_name(axis, noise_mm):
    source, target, _ = noisy_pair(8, noise_mm=noise_mm)
    source[:, axis] *= -1
    with pytest.raises(CalibrationError, match="cameras are swapped or a picture is mirrored"):
        fit(source, target)


def test_erratum_3_coplanar_points_hide_the_mirror_and_the_fit_says_untested():
    source, _, rotation = noisy_pair(9)
    source[:, 2] = 0.0
    found = fit(source * [1, 1, -1], source @ rotation.T)
    assert found.rmse_mm < 1e-9
    assert found.handedness == "untested"
