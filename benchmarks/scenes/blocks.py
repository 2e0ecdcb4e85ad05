"""A block beside a hip, as points: its balls, targets and picks, and a Γ frame in the same beams.

A lower bound of the error of targets, as `sightline.studies.bound` has it for plates. On flat panels. Data: the pixels
of the balls in all views and the picks of the target. Unknowns of each view: its pose, without a prior; its focal
length and principal point, with those of an estimator. The errors of the balls have the frame's prior and are shared by
all views. A change of focal length and principal point is a movement of the focal point against the detector; what else
it does is a movement of both, which the pose contains.

On intensifiers with a plate on the detector the data are the pixels of its balls too, and all are mapped to its plane.
The map is a cubic with a flat prior and a remainder with that which it was drawn from (`bound`). The pose is the
solid's against the plate.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from benchmarks.harness import mahalanobis2
from sightline.calibration import CArm
from sightline.calibration.solids.adjustment import CENTRE_SD_MM, DISTANCE_SD_MM, PLATE_CENTRE_SD_MM
from sightline.detection import Observations
from sightline.frame import Frame, Tolerances
from sightline.studies.bound import (
    BoundData,
    Linear,
    cubic_terms,
    derivative,
    plane_per_pixel,
    snapped,
    target_bound,
)
from sightline.studies.scenes import TargetScene, measure
from sightline.twin import SetUp, ViewTruth
from sightline.twin.xray.distributions import NEAR_PLACE, SolidPlace
from sightline.twin.xray.setup import shadow_centres_px, with_errors

BEAD_PX = PICK_PX = 0.1


def block(ball_mm: float, name: str = "block60") -> Frame:
    """Return a block with a stated error of its balls, 1 s.d. per axis."""
    return replace(Frame.load(name), tolerances=Tolerances(ball_mm, 0.0, 0.0, 0.0, 0.0))


def c_arms(setup: SetUp) -> list[CArm]:
    """Return what the software knows of the C-arm of each view."""
    return [CArm(view.chain.sdd_mm, view.chain.pitch_mm) for view in setup.views.values()]


def pick_covariance(views: int, points: int) -> np.ndarray:
    """Return the covariances (V, N, 2, 2) of picks."""
    return np.broadcast_to(PICK_PX**2 * np.eye(2), (views, points, 2, 2))


def gamma_in(setup: SetUp, rng: np.random.Generator) -> TargetScene:
    """Return a Γ frame of default tolerances in the beams of a block's set-up, with the target in its middle.

    The views are moved so that they are aimed at the middle of the Γ frame, as they were at a place beside the hip.
    """
    frame = Frame.load("gamma")
    place = SolidPlace() if setup.frame.detector is None else NEAR_PLACE
    aim = (1.0 - place.aim) * setup.hip_mm  # the block's middle is the origin
    views = {}
    for name, view in setup.views.items():
        detector = replace(view.detector, origin_mm=view.detector.origin_mm - aim)
        views[name] = replace(view, focal_point_mm=view.focal_point_mm - aim, detector=detector)
    moved = SetUp(frame, with_errors(frame, rng), views, setup.side, setup.tube)
    return TargetScene.of(moved, measure(rng, moved, BEAD_PX), np.zeros((1, 3)))


def centre_squares(setup: SetUp, seen: Observations) -> np.ndarray:
    """Return the squared Mahalanobis lengths (N,) of the errors of measured centres."""
    balls = {ball.id: ball for ball in setup.true_frame.fiducials}
    xyz = np.array([balls[i].xyz_mm for i in seen.ids])
    radius = np.array([balls[i].diameter_mm / 2 for i in seen.ids])
    assert seen.covariance_px2 is not None
    return mahalanobis2(seen.uv_px - shadow_centres_px(setup.views[seen.view], xyz, radius), seen.covariance_px2)


def solid_bound(setup: SetUp, seen: dict[str, BoundData], target_mm: np.ndarray) -> np.ndarray:
    """Return the lower bound (3, 3), mm², of the covariance of a target at `target_mm` (3,), CFCS.

    `seen`: the data of each view, two or more. The priors of focal length and principal point are those of
    `calibrate_together` where the file states the source-detector distance. The twin draws 3 mm for the focal length
    and 5 mm for the principal point (`Pose`).
    """
    across = CENTRE_SD_MM if setup.frame.detector is None else PLATE_CENTRE_SD_MM
    prior = np.array([across, across, DISTANCE_SD_MM])
    linearised = _linearised if setup.frame.detector is None else _on_plate
    return target_bound([linearised(setup, name, data, target_mm, prior) for name, data in seen.items()])


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


def _on_plate(setup: SetUp, name: str, seen: BoundData, target_mm: np.ndarray, prior_mm: np.ndarray) -> Linear:
    """Return a view with a plate on the detector, on the plate's plane, mm. `prior_mm` (3,): of the focal point, along
    the plane's axes and its normal."""
    truth, frame, pose = setup.views[name], setup.frame_in(name), setup.T_cfcs_plate(name)
    assert frame.detector is not None
    plane, focal = frame.detector.plane, truth.focal_point_mm
    places = [bead.id for bead in frame.fiducials]
    rows = np.array([places.index(i) for i in seen.ids])
    xyz = np.vstack([frame.xyz_mm[rows], target_mm])
    n, uv = len(xyz), truth.project(xyz)
    moves = np.append(~np.isin(seen.ids, frame.detector.ids), True)  # the solid and the target, against the plate
    by_point = derivative(partial(plane.central_projection, focal), xyz)
    by_focal = derivative(lambda f: plane.central_projection(f[0], xyz), focal[None]) @ plane.basis.T
    centred = xyz - xyz[moves].mean(axis=0)
    rotations = np.stack([np.cross(axis, centred) for axis in np.eye(3)], axis=-1)
    rigid = np.concatenate([by_point, by_point @ rotations], axis=-1) * moves[:, None, None]
    factor = setup.frame.error_factor.reshape(len(places), 3, -1)[rows]
    factor = np.where(moves[:-1, None, None], factor, pose.rotation.as_matrix() @ factor)
    response = np.zeros((n, 2, factor.shape[-1]))
    response[:-1] = by_point[:-1] @ factor
    jacobian = plane_per_pixel(truth, plane, xyz, by_point)
    to_mm = np.asarray(block_diag(*jacobian))
    noise_px = np.asarray(block_diag(*seen.bead_px2, seen.pick_px2)) + truth.beyond_cubic_covariance(uv)
    inner = by_focal.reshape(2 * n, 3) * prior_mm
    out = Linear(
        nuisance=np.hstack([rigid.reshape(2 * n, 6), np.kron(cubic_terms(uv), np.eye(2))]),
        target=np.vstack([np.zeros((2 * n - 2, 3)), by_point[-1]]),
        response=response.reshape(2 * n, -1),
        covariance=to_mm @ noise_px @ to_mm.T + inner @ inner.T,
    )
    return snapped(out, jacobian[-1], seen.across_px)


def _from(truth: ViewTruth, focal_mm: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points for a focal point (3,) that has moved against the detector."""
    return replace(truth, focal_point_mm=focal_mm).project(xyz_mm)
