"""The pose of a rigid body of balls in two images of one instant, without labels.

Each pair of balls whose lines of sight meet is a candidate. Candidates with the body's distances are fitted to it, and
the pose is accepted where one assignment alone agrees with its errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.distance import cdist
from scipy.spatial.transform import RigidTransform

from sightline.calibration.view import CalibratedView
from sightline.common.geometry.covariance import ellipsoid_factor
from sightline.common.geometry.rigid import displacement, rigid_fit
from sightline.common.threads import one_blas_thread
from sightline.errors import ErrorUnknownError, UnusableInputError
from sightline.planning.points.gaps import CONFIDENCE
from sightline.planning.points.many import OK, ManySolver
from sightline.planning.points.reconstruct import reconstruct
from sightline.planning.points.results import MAX_GAP_SIGMA

MIN_BALLS = 3
MIN_HEIGHT_MM = 3.0  # [ours] of the body across its longest axis: 0.05 mm on each ball then turn it by 1°
MAX_DETECTED = 100  # balls in one image [ours]: implanted beads are fewer
_MAX_ASSIGNMENTS = 200  # [ours] partial ones; more only in a lattice
_SLACK = 4.0  # s.d. by which a distance may differ before the fit decides [ours]

HIDDEN, OTHER, EXCHANGED = "a ball is hidden", "no balls fit the body", "balls may be exchanged"


class Centres(Protocol):
    """N balls of one image, such as `Detections`."""

    @property
    def uv_px(self) -> np.ndarray:
        """(N, 2) their centres."""
        ...

    @property
    def covariance_px2(self) -> np.ndarray:
        """(N, 2, 2) of the centres."""
        ...

    def __len__(self) -> int: ...


@dataclass(frozen=True, eq=False)
class BallBody:
    """M balls at `xyz_mm` (M, 3), the body's own axes, with the covariance of their errors (3M, 3M).

    Raises UnusableInputError for a body that determines no pose.
    """

    ids: tuple[str, ...]
    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray

    def __post_init__(self) -> None:
        spread = np.linalg.svd(self.xyz_mm - self.xyz_mm.mean(axis=0), compute_uv=False)
        if len(self.ids) < MIN_BALLS or spread[1] < MIN_HEIGHT_MM:
            raise UnusableInputError(
                f"the body has {len(self.ids)} balls, {spread[min(1, len(spread) - 1)]:.3g} mm (rms sum) off one line; "
                f"give {MIN_BALLS} or more, in mm, at least {MIN_HEIGHT_MM:g} mm off"
            )


@dataclass(frozen=True, eq=False)
class BodyPose:
    """The body's mean ball at `centre_mm` (3,), CFCS, its axes turned by `rotation`; `covariance` (6, 6) of a small
    rotation about the centre (rad, CFCS) and of the centre (mm). `xyz_mm` (M, 3): the balls as reconstructed."""

    centre_mm: np.ndarray
    pose: RigidTransform
    covariance: np.ndarray
    xyz_mm: np.ndarray
    rms_mm: float


class BodyFinder:
    """Finds one body in pairs of images of the same two views. Raises what `ManySolver` raises, ErrorUnknownError."""

    def __init__(self, views: Sequence[CalibratedView], body: BallBody | None = None) -> None:
        self._solver, self.body = ManySolver(views), body
        if not self._solver.errors_known or len(views) != 2:
            raise ErrorUnknownError("a body needs two views that state their errors; calibrate both from their balls")

    @one_blas_thread
    def find(self, seen: Sequence[Centres]) -> BodyPose | str:
        """Return the pose in the detections of both images, or why there is none.

        Without a body, that of the first pair whose balls match one to one is taken for all.
        """
        if min(map(len, seen)) < MIN_BALLS or max(map(len, seen)) > MAX_DETECTED:
            return HIDDEN if min(map(len, seen)) < MIN_BALLS else OTHER
        pairs, xyz, sd = self._candidates(seen)
        if self.body is None and not (len(seen[0]) == len(seen[1]) == len(xyz) == len(set(pairs[1].tolist()))):
            return "the balls of both images do not match one to one"
        if self.body is None:
            points, joint = self._points(seen, pairs)
            self.body = BallBody(tuple(map(str, range(1, len(points) + 1))), points, joint)
            return _fit(BallBody(self.body.ids, points, 0.0 * joint), points, joint)[0]
        if min(map(len, seen)) < len(self.body.ids):
            return HIDDEN
        assigned = _assignments(self.body, pairs, xyz, sd)
        if len(assigned) > _MAX_ASSIGNMENTS:
            return EXCHANGED
        fits = [_fit(self.body, *self._points(seen, pairs[:, list(each)])) for each in assigned]
        limit = ellipsoid_factor(CONFIDENCE, 3 * len(self.body.ids) - 6) ** 2
        good = [pose for pose, square in fits if square <= limit]
        return good[0] if len(good) == 1 else EXCHANGED if good else OTHER

    def _candidates(self, seen: Sequence[Centres]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which detections (2, K) have lines of sight that meet, where (K, 3), and the largest s.d. (K,)."""
        pairs = np.indices((len(seen[0]), len(seen[1]))).reshape(2, -1)
        uv = np.array([each.uv_px[k] for each, k in zip(seen, pairs, strict=True)])
        variance = [np.linalg.eigvalsh(each.covariance_px2)[k, -1] for each, k in zip(seen, pairs, strict=True)]
        found = self._solver.solve(uv, np.sqrt(variance))
        assert found.gap_sigma is not None and found.covariance_mm2 is not None  # noqa: S101 - errors are known
        kept = np.flatnonzero((found.reason == OK) & (np.nan_to_num(found.gap_sigma, nan=np.inf) <= MAX_GAP_SIGMA))
        sd = np.sqrt(np.linalg.eigvalsh(found.covariance_mm2[kept])[:, -1])
        return pairs[:, kept], found.xyz_mm[kept], sd

    def _points(self, seen: Sequence[Centres], pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (M, 3) of pairs of detections (2, M), and their joint covariance (3M, 3M)."""
        uv, covariance = (
            np.array([getattr(each, name)[k] for each, k in zip(seen, pairs, strict=True)])
            for name in ("uv_px", "covariance_px2")
        )
        points = reconstruct(self._solver.views, uv, covariance)
        assert points.joint_covariance_mm2 is not None  # noqa: S101 - errors are known
        return points.xyz_mm, points.joint_covariance_mm2


def _assignments(body: BallBody, pairs: np.ndarray, xyz_mm: np.ndarray, sd_mm: np.ndarray) -> list[tuple[int, ...]]:
    """Return which candidates may be the body's balls, in their order: by distance, each detection used once.

    More than _MAX_ASSIGNMENTS are not complete.
    """
    own_sd = np.sqrt(np.max(np.linalg.eigvalsh(body.covariance_mm2)))
    apart, wanted = cdist(xyz_mm, xyz_mm), cdist(body.xyz_mm, body.xyz_mm)
    slack = _SLACK * (sd_mm[:, None] + sd_mm + own_sd)
    other = (pairs[:, :, None] != pairs[:, None, :]).all(axis=0)
    partial: list[tuple[int, ...]] = [(k,) for k in range(len(xyz_mm))]
    for ball in range(1, len(body.ids)):
        grown: list[tuple[int, ...]] = []
        for chosen in partial:
            at = list(chosen)
            fits = other[at] & (np.abs(apart[at] - wanted[:ball, ball, None]) <= slack[at])
            grown += [(*chosen, int(k)) for k in np.flatnonzero(fits.all(axis=0))]
        partial = grown
        if len(partial) > _MAX_ASSIGNMENTS:
            break
    return partial


def _fit(body: BallBody, xyz_mm: np.ndarray, covariance_mm2: np.ndarray) -> tuple[BodyPose, float]:
    """Return the generalised least-squares pose of the body at points (M, 3), and the chi-square of the residuals."""
    pose = rigid_fit(body.xyz_mm, xyz_mm)
    turn = block_diag(*[pose.rotation.as_matrix()] * len(xyz_mm))
    weight = np.linalg.inv(covariance_mm2 + turn @ body.covariance_mm2 @ turn.T)
    covariance = np.zeros((6, 6))
    for _ in range(2):
        at = pose.apply(body.xyz_mm)
        centre = at.mean(axis=0)
        by_twist = displacement(at - centre).reshape(-1, 6)
        covariance = np.linalg.inv(by_twist.T @ weight @ by_twist)
        twist = covariance @ by_twist.T @ weight @ (xyz_mm - at).ravel()
        about = RigidTransform.from_translation(centre)
        pose = about * RigidTransform.from_exp_coords(twist) * about.inv() * pose
    at = pose.apply(body.xyz_mm)
    off = (xyz_mm - at).ravel()
    found = BodyPose(at.mean(axis=0), pose, covariance, xyz_mm, float(np.sqrt((off**2).sum() / len(xyz_mm))))
    return found, float(off @ weight @ off)
