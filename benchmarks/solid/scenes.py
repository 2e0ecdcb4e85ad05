"""A block beside a hip, as points: its balls, targets and picks; a Γ frame in the same beams."""

from dataclasses import replace

import numpy as np

from sightline.calibration import BeadView, CArm
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.detection import Observations
from sightline.frame import Frame, Tolerances
from sightline.studies.scenes import TargetScene, measure
from sightline.twin import SetUp
from sightline.twin.xray.distributions import NEAR_PLACE, SolidPlace
from sightline.twin.xray.setup import shadow_centres_px, with_errors

BEAD_PX = PICK_PX = 0.1


def block(ball_mm: float) -> Frame:
    """Return `block60` with a stated error of its balls, 1 s.d. per axis."""
    return replace(Frame.load("block60"), tolerances=Tolerances(ball_mm, 0.0, 0.0, 0.0, 0.0))


def c_arms(setup: SetUp) -> list[CArm]:
    """Return what the software knows of the C-arm of each view."""
    return [CArm(view.chain.sdd_mm, view.chain.pitch_mm) for view in setup.views.values()]


def calibrated(scene: TargetScene) -> tuple[BeadView, ...]:
    """Return the views of a scene of a block, adjusted together."""
    return calibrate_together(list(scene.observations.values()), scene.frame, c_arms(scene.setup))


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
    views = {
        name: replace(
            view,
            focal_point_mm=view.focal_point_mm - aim,
            detector=replace(view.detector, origin_mm=view.detector.origin_mm - aim),
        )
        for name, view in setup.views.items()
    }
    moved = SetUp(frame, with_errors(frame, rng), views, setup.side, setup.tube)
    return TargetScene.of(moved, measure(rng, moved, BEAD_PX), np.zeros((1, 3)))


def centre_squares(setup: SetUp, seen: Observations) -> np.ndarray:
    """Return the squared Mahalanobis lengths (N,) of the errors of measured centres."""
    balls = {ball.id: ball for ball in setup.true_frame.fiducials}
    xyz = np.array([balls[i].xyz_mm for i in seen.ids])
    radius = np.array([balls[i].diameter_mm / 2 for i in seen.ids])
    assert seen.covariance_px2 is not None
    return squares_of(seen.uv_px - shadow_centres_px(setup.views[seen.view], xyz, radius), seen.covariance_px2)


def squares_of(off: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the squared Mahalanobis lengths (N,) of errors (N, D) with covariances (N, D, D)."""
    return np.einsum("na,na->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
