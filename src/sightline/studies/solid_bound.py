"""Lower bound of the error of targets for a solid of balls on flat panels, as bound.py has it for plates.

Data: the pixels of the balls in all views and the picks of the target. Unknowns of each view: its pose, without a
prior; its focal length and principal point, with those of an estimator. The errors of the balls have the frame's prior
and are shared by all views.

A change of focal length and principal point is a movement of the focal point against the detector; what else it does
is a movement of both, which the pose contains.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from sightline.calibration.solid_start import CENTRE_SD_MM, DISTANCE_SD_MM
from sightline.studies.bound import BoundData, Linear, derivative, snapped, target_bound
from sightline.twin import SetUp, ViewTruth


def solid_bound(
    setup: SetUp,
    seen: dict[str, BoundData],
    target_mm: np.ndarray,
    *,
    focal_length_mm: float = DISTANCE_SD_MM,
    principal_point_mm: float = CENTRE_SD_MM,
) -> np.ndarray:
    """Return the lower bound (3, 3), mm², of the covariance of a target at `target_mm` (3,), CFCS.

    `seen`: the data of each view, two or more. The priors are 1 s.d., of each coordinate of the principal point;
    by default those of `calibrate_together` where the file states the source-detector distance. The twin draws 3 mm for
    the focal length and 5 mm for the principal point (`Pose`).
    """
    prior = np.array([principal_point_mm, principal_point_mm, focal_length_mm])
    return target_bound([_linearised(setup, name, one, target_mm, prior) for name, one in seen.items()])


def _linearised(setup: SetUp, name: str, seen: BoundData, target_mm: np.ndarray, prior_mm: np.ndarray) -> Linear:
    """Return a view, in pixels. `prior_mm` (3,): of the focal point, along the detector's axes and its normal."""
    truth, frame = setup.views[name], setup.true_frame
    places = [bead.id for bead in frame.fiducials_of(name)]
    rows = np.array([places.index(i) for i in seen.ids])
    xyz = np.vstack([[frame.xyz_mm_by_id[i] for i in seen.ids], target_mm])
    n = len(xyz)
    by_point = derivative(truth.project, xyz)
    by_focal = derivative(lambda f: _from(truth, f[0], xyz), truth.focal_point_mm[None]) @ truth.detector.basis.T
    centred = xyz - xyz.mean(axis=0)
    rotations = np.stack([np.cross(axis, centred) for axis in np.eye(3)], axis=-1)
    pose = np.concatenate([by_point, by_point @ rotations], axis=-1)
    factor = setup.frame.error_factor[setup.frame.rows(name)].reshape(len(places), 3, -1)[rows]
    response = np.zeros((n, 2, factor.shape[-1]))
    response[:-1] = by_point[:-1] @ factor
    inner = by_focal.reshape(2 * n, 3) * prior_mm
    out = Linear(
        nuisance=pose.reshape(2 * n, 6),
        target=np.vstack([np.zeros((2 * n - 2, 3)), by_point[-1]]),
        response=response.reshape(2 * n, -1),
        covariance=np.asarray(block_diag(*seen.bead_px2, seen.pick_px2)) + inner @ inner.T,
    )
    return snapped(out, np.eye(2), seen.across_px)


def _from(truth: ViewTruth, focal_mm: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points for a focal point (3,) that has moved against the detector."""
    return replace(truth, focal_point_mm=focal_mm).project(xyz_mm)
