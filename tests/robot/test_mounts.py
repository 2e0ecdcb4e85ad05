"""Mounts on the flange: found again within their stated covariance, refused where they are not determined."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.calibrated import measured_axis, measured_mount

TRUE = RigidTransform.from_exp_coords([0.4, -1.1, 0.7, 83.0, -41.5, 120.25])
SD = 0.05
TRIALS = 100


def chi2_per_axis(errors: np.ndarray, covariances: np.ndarray) -> float:
    """Mean squared normalised error; 1 if the covariance is honest, within 3 s.d. for the trials."""
    return float(
        np.mean([e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)]) / len(errors[0])
    )


def twist(found: RigidTransform, true: RigidTransform) -> np.ndarray:
    return (found * true.inv()).as_exp_coords()


def points(rng: np.random.Generator, n: int = 8) -> np.ndarray:
    return rng.uniform(-60, 60, (n, 3))


def test_a_measured_mount_errs_as_it_says():
    rng = np.random.default_rng(3)
    errors, covariances = [], []
    for _ in range(TRIALS):
        own = points(rng)
        mount = measured_mount(own, TRUE.apply(own) + SD * rng.standard_normal(own.shape), SD)
        errors.append(twist(mount.pose, TRUE))
        covariances.append(mount.covariance)
    assert abs(chi2_per_axis(np.array(errors), np.array(covariances)) - 1) < 3 * np.sqrt(2 / (6 * TRIALS))


def test_swapped_and_collinear_points_are_refused():
    rng = np.random.default_rng(4)
    own = points(rng)
    with pytest.raises(RobotRefusedError, match="swapped"):
        measured_mount(own, TRUE.apply(own[[1, 0, *range(2, 8)]]), SD)
    line = np.outer(np.arange(5.0), [10.0, 20.0, 5.0])
    with pytest.raises(UnusableInputError, match="one line"):
        measured_mount(line, TRUE.apply(line), SD)
    with pytest.raises(UnusableInputError, match="three points"):
        measured_mount(own[:2], own[:2], SD)
    with pytest.raises(UnusableInputError, match="finite"):
        measured_mount(own, np.where(own > 50, np.nan, own), SD)


def test_a_measured_axis_errs_as_it_says():
    rng = np.random.default_rng(5)
    feeds = np.array([0.0, 40.0, 90.0, 150.0, 210.0])
    z = TRUE.rotation.apply([0.0, 0.0, 1.0])
    errors, covariances = [], []
    for _ in range(TRIALS):
        tips = TRUE.translation + feeds[:, None] * z + SD * rng.standard_normal((5, 3))
        mount = measured_axis(feeds, tips, SD)
        # Judged by what counts: where two points of the axis are, all six numbers of them but two.
        shift = np.concatenate([_at(mount.pose, feed) - TRUE.translation - feed * z for feed in (0.0, 200.0)])
        design = np.concatenate([_design(mount.pose, feed) for feed in (0.0, 200.0)])
        covariance = design @ mount.covariance @ design.T
        errors.append(shift[[0, 1, 2, 3, 4]])
        covariances.append(covariance[:5, :5])
    assert abs(chi2_per_axis(np.array(errors), np.array(covariances)) - 1) < 3 * np.sqrt(2 / (5 * TRIALS))


def _at(pose: RigidTransform, feed: float) -> np.ndarray:
    return pose.apply([0.0, 0.0, feed])


def _design(pose: RigidTransform, feed: float) -> np.ndarray:
    from sightline.common.geometry.rigid import displacement

    return displacement(_at(pose, feed))


def test_an_axis_that_is_none_is_refused():
    feeds = np.array([0.0, 50.0, 100.0])
    tips = np.outer(feeds, [0.0, 0.6, 0.8])
    with pytest.raises(RobotRefusedError, match="tips"):
        measured_axis(feeds, tips + np.array([[0, 0, 0], [1.0, 0, 0], [0, 0, 0]]), SD)
    with pytest.raises(RobotRefusedError, match="tips"):
        measured_axis(feeds, 1.01 * tips, SD)  # fed further than the encoder says
    with pytest.raises(UnusableInputError, match="further apart"):
        measured_axis(feeds / 100, tips / 100, SD)
