"""Many points at once: place and covariance against matrices of numpy, and why a point is left out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sightline as sl
from sightline.detection import Observations
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning.points.many import (
    APART,
    BEHIND,
    FEW,
    OK,
    OUTSIDE,
    PARALLEL,
    ManySolver,
    gap_check,
    without_distortion,
)
from sightline.twin.xray.setup import SetUp, bead_images

SD_PX = 0.3


def _matrix(angle_deg: float, distance_mm: float = 620.0) -> np.ndarray:
    """(3, 4): a camera turned about y, off every axis, whose source is so far from the origin."""
    rotation = Rotation.from_euler("yx", [angle_deg, 7.3], degrees=True).as_matrix()
    inner = np.array([[4760.0, 0.0, 507.3], [0.0, 4760.0, 498.1], [0.0, 0.0, 1.0]])
    return inner @ np.column_stack([rotation, [2.7, -3.9, distance_mm]])


def _pixels(matrix: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    image = np.column_stack([xyz, np.ones(len(xyz))]) @ matrix.T
    return image[:, :2] / image[:, 2:]


MATRICES = [_matrix(3.1), _matrix(-86.4), _matrix(44.9)]
# Of the matrix's own scale: some 0.5 px, different in each entry.
COVARIANCE = [np.diag((1.5e-4 * np.abs(matrix).ravel()) ** 2) for matrix in MATRICES]
XYZ = np.random.default_rng(3).uniform(-60.0, 60.0, (500, 3))
UV = np.array([_pixels(matrix, XYZ) for matrix in MATRICES])
SD = np.full(UV.shape[:2], SD_PX)


def _solver(count: int = 3, *, known: bool = True, scale: float = 1.0) -> ManySolver:
    each = zip(MATRICES[:count], COVARIANCE, "abc", strict=False)
    views = [sl.view_from_matrix(scale_to(m, scale), c if known else None, name) for m, c, name in each]
    return ManySolver(views)


def scale_to(matrix: np.ndarray, scale: float) -> np.ndarray:
    """The matrix of the same camera in other units of length: its source `scale` times as far from the origin."""
    return matrix @ np.diag([1.0, 1.0, 1.0, scale])


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("count", [2, 3])
def test_pixels_of_a_matrix_give_the_point_back(count: int, *, known: bool) -> None:
    found = _solver(count, known=known).solve(UV[:count], SD[:count])
    assert (found.reason == OK).all()
    np.testing.assert_allclose(found.xyz_mm, XYZ, atol=1e-6)  # rounding, over 620 mm
    np.testing.assert_allclose(found.gap_mm, 0.0, atol=1e-6)
    assert (found.covariance_mm2 is not None) == known


def test_the_covariance_and_the_gap_are_those_of_samples() -> None:
    rng = np.random.default_rng(11)
    squares, sigmas = [], []
    for _ in range(150):
        errors = [rng.normal(0.0, np.sqrt(np.diag(c))).reshape(3, 4) for c in COVARIANCE[:2]]
        views = [
            sl.view_from_matrix(m + e, c, name)
            for m, e, c, name in zip(MATRICES, errors, COVARIANCE, "ab", strict=False)
        ]
        found = ManySolver(views).solve(UV[:2, :8] + rng.normal(0.0, SD_PX, (2, 8, 2)), SD[:2, :8])
        off = found.xyz_mm - XYZ[:8]
        squares += np.einsum("ia,iab,ib->i", off, np.linalg.inv(found.covariance_mm2), off).tolist()
        sigmas += found.gap_sigma.tolist()
    # Mean of chi-square with 3 degrees of freedom; the 8 points of a draw share the matrices' errors: 5 s.d. of the
    # mean over 150 draws are 1.0 if they were fully alike.
    assert np.mean(squares) == pytest.approx(3.0, abs=0.6)
    assert np.mean(np.square(sigmas)) == pytest.approx(1.0, abs=0.35)


def test_points_are_those_of_reconstruct_with_the_covariance_of_a_near_one(setup: SetUp) -> None:
    rng = np.random.default_rng(5)
    beads = {name: bead_images(setup, name, rng) for name in ("pa", "lateral")}
    views = [sl.calibrate(Observations(name, ids, uv), setup.frame) for name, (ids, uv) in beads.items()]
    xyz = rng.uniform(-30.0, 30.0, (30, 3))
    xyz = np.concatenate([xyz, xyz + rng.uniform(-1.5, 1.5, xyz.shape)])  # pairs, many of them in one cell
    uv = np.array([view.project(xyz) for view in views]) + rng.normal(0.0, SD_PX, (2, 60, 2))
    found = ManySolver(views).solve(uv, np.full((2, 60), SD_PX))
    joint = sl.reconstruct(views, uv, np.broadcast_to(SD_PX**2 * np.eye(2), (2, 60, 2, 2)))
    sd = np.sqrt(np.diagonal(joint.covariance_mm2, axis1=1, axis2=2))
    assert (np.abs(found.xyz_mm - joint.xyz_mm) < 0.02 * sd).all()
    np.testing.assert_allclose(found.covariance_mm2, joint.covariance_mm2, atol=0.03 * (sd**2).max())
    np.testing.assert_allclose(found.gap_sigma, joint.gap_sigma, rtol=0.02)
    assert not without_distortion(views)
    far = ManySolver(views).solve(np.full((2, 1, 2), -5000.0), SD[:2, :1])
    assert far.reason.tolist() == [OUTSIDE]


def test_each_point_that_is_not_reconstructed_says_why() -> None:
    uv = UV[:2, :5].copy()
    uv[1, 0] = np.nan
    uv[1, 1, 1] += 400.0  # another point
    views = [sl.view_from_matrix(m, None, name) for m, name in zip(MATRICES[:2], "ab", strict=True)]
    found = ManySolver(views).solve(uv, SD[:2, :5])
    assert found.reason.tolist() == [FEW, APART, OK, OK, OK]
    np.testing.assert_allclose(found.xyz_mm[2:], XYZ[2:5], atol=1e-6)
    assert np.isnan(found.xyz_mm[:2]).all()
    near = [sl.view_from_matrix(m, None, name) for m, name in ((MATRICES[0], "a"), (_matrix(5.4), "b"))]
    seen = np.array([_pixels(m, XYZ[:2]) for m in (MATRICES[0], _matrix(5.4))])
    assert ManySolver(near).solve(seen, SD[:2, :2]).reason.tolist() == [PARALLEL, PARALLEL]
    source = -np.linalg.solve(MATRICES[0][:, :3], MATRICES[0][:, 3])
    beyond = (source + (source - XYZ[0]) * 0.4)[None]  # on the line through the source, on its other side
    seen = np.array([_pixels(m, beyond) for m in MATRICES[:2]])
    assert ManySolver(views).solve(seen, SD[:2, :1]).reason.tolist() == [BEHIND]


def test_exchanged_cameras_and_views_in_metres_are_refused() -> None:
    solver = _solver(known=False)
    solver.refuse_exchanged(UV)
    with pytest.raises(UnusableInputError, match="views a and c are exchanged"):
        solver.refuse_exchanged(UV[[2, 1, 0]])
    with pytest.raises(ReconstructionRefusedError, match="in metres"):
        _solver(2, known=False, scale=2e-3)  # sources 1.24 m away


def test_y_counted_from_below_is_refused_and_named_where_the_lines_do_not_show_it() -> None:
    """Two cameras in one plane, whose images are upright, see the mirror image of any points; not so a turned one."""
    inner = np.array([[4760.0, 0.0, 507.3], [0.0, 4760.0, 498.1], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(1)
    for roll, ambiguous in ((0.0, True), (35.0, False)):
        turns = Rotation.from_euler("yz", [[3.0, 0.0], [-86.0, roll]], degrees=True).as_matrix()
        matrices = [inner @ np.column_stack([turn, [0.0, 0.0, 620.0]]) for turn in turns]
        solver = ManySolver([sl.view_from_matrix(m, None, name) for m, name in zip(matrices, "ab", strict=True)])
        uv = np.array([_pixels(m, XYZ[:40]) for m in matrices]) + rng.normal(0.0, SD_PX, (2, 40, 2))
        assert solver.refuse_upward(uv) is ambiguous and not solver.refuse_upward(uv[:, :5])
    with pytest.raises(UnusableInputError, match="y is counted from below"):
        solver.refuse_upward(uv * [1.0, -1.0] + [0.0, 1023.0])


def test_points_that_are_not_of_the_images_fail_the_check() -> None:
    """Distortion of 5 px at the edge, or y counted from below, where neither is expected."""
    for known in (True, False):
        solver = _solver(2, known=known)
        good = solver.solve(UV[:2], SD[:2])
        assert gap_check(good.gap_mm, good.gap_sigma, good.reason).passed
        off = UV[:2] - 500.0
        distorted = UV[:2] + (0.08 if known else 0.3) * off * (off**2).sum(axis=2, keepdims=True) / 500.0**2
        upward = np.stack([UV[:2, :, 0], 1023.0 - UV[:2, :, 1]], axis=-1)
        shifted = np.array([UV[0], UV[1] + [0.0, 30.0]])
        for wrong in (distorted, upward, shifted):
            bad = solver.solve(wrong, SD[:2])
            assert not gap_check(bad.gap_mm, bad.gap_sigma, bad.reason).passed
    nothing = solver.solve(np.full((2, 3, 2), np.nan), SD[:2, :3])
    assert not gap_check(nothing.gap_mm, nothing.gap_sigma, nothing.reason).passed
