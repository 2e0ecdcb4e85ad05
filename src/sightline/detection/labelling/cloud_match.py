"""From a hypothesis to a labelling: match balls and fit a pinhole camera in turn until the matches are stable."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import gammaln

from sightline.common.kernels import kernel
from sightline.detection.labelling.cloud_search import Hypothesis, Prior, Problem, sign_of
from sightline.detection.labelling.seeds import RADIUS_RATIO

STEPS = 4  # Gauss-Newton steps of a fit; from a hypothesis three suffice for 0.01 px [calc]
PARAMETERS = 9


class Camera(NamedTuple):
    """A pinhole camera with square pixels, seen from a point in the middle of the balls.

    `matrix` (3, 3) rotates the balls' axes into right, down and along the beam. `numbers` (6,): pixel u, v of the
    point `middle_mm` (3,), log px/mm there, log focal length (px), principal point u, v.
    """

    matrix: np.ndarray
    middle_mm: np.ndarray
    numbers: np.ndarray


class Fit(NamedTuple):
    """A camera fitted to balls, see `fit`."""

    camera: Camera
    precision: np.ndarray
    chi2: float
    half_log_det: float


@kernel()
def project(camera, xyz_mm):
    """Return pixels (N, 2) of points (N, 3), px/mm (N,) there, and the derivatives (N, 2, 9) of the pixels.

    Parameters: rotation vector (camera axes), then the camera's `numbers`.
    """
    u0, v0, log_scale, log_focal, pu, pv = camera.numbers
    scale, focal = np.exp(log_scale), np.exp(log_focal)
    n = len(xyz_mm)
    uv, scales, by = np.empty((n, 2)), np.empty(n), np.zeros((n, 2, PARAMETERS))
    for k in range(n):
        x, y, z = scale * (camera.matrix @ (xyz_mm[k] - camera.middle_mm))
        depth = 1 + z / focal
        scales[k] = scale / depth
        for axis in range(2):
            q = ((u0 - pu + x) if axis == 0 else (v0 - pv + y)) / depth
            uv[k, axis] = q + camera.numbers[4 + axis]
            by_x, by_y, by_z = (1.0 - axis) / depth, axis / depth, -q / focal / depth
            row = by[k, axis]
            row[0], row[1], row[2] = y * by_z - z * by_y, z * by_x - x * by_z, x * by_y - y * by_x
            row[3 + axis] = 1 / depth
            row[5] = x * by_x + y * by_y + z * by_z
            row[6] = -by_z * z
            row[7 + axis] = 1 - 1 / depth
    return uv, scales, by


@kernel()
def _normal_equations(camera, prior, xyz_mm, uv_px, variance_px2):
    """Return the precision (9, 9), the gradient (9,), chi-square, and half the log determinants of the covariances."""
    uv, _, by = project(camera, xyz_mm)
    precision, gradient, chi2, half_log_det = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS), 0.0, 0.0
    for k in range(len(xyz_mm)):
        a, b, c = variance_px2[k, 0, 0], variance_px2[k, 0, 1], variance_px2[k, 1, 1]
        determinant = a * c - b * b
        half_log_det += 0.5 * np.log(determinant)
        off_u, off_v = uv_px[k, 0] - uv[k, 0], uv_px[k, 1] - uv[k, 1]
        du, dv = (c * off_u - b * off_v) / determinant, (a * off_v - b * off_u) / determinant
        chi2 += du * off_u + dv * off_v
        for i in range(PARAMETERS):
            ju, jv = by[k, 0, i], by[k, 1, i]
            wu, wv = (c * ju - b * jv) / determinant, (a * jv - b * ju) / determinant
            gradient[i] += ju * du + jv * dv
            for j in range(i + 1):
                precision[i, j] += wu * by[k, 0, j] + wv * by[k, 1, j]
    for i in range(PARAMETERS):
        for j in range(i):
            precision[j, i] = precision[i, j]
    for i in range(3):
        weight = (prior.log_focal_sd if i == 0 else prior.principal_sd_px) ** -2
        away = (prior.log_focal if i == 0 else prior.principal_px[i - 1]) - camera.numbers[3 + i]
        precision[6 + i, 6 + i] += weight
        gradient[6 + i] += weight * away
        chi2 += weight * away**2
    return precision, gradient, chi2, half_log_det


@kernel()
def _rotated(matrix, vector):
    """Return the rotation by a small rotation vector, to second order and made orthonormal again, of a matrix."""
    rotated = np.empty((3, 3))
    for c in range(3):
        column = matrix[:, c]
        first = np.cross(vector, column)
        rotated[:, c] = column + first + 0.5 * np.cross(vector, first)
    x = rotated[0] / np.sqrt(rotated[0] @ rotated[0])
    y = rotated[1] - (rotated[1] @ x) * x
    y /= np.sqrt(y @ y)
    rotated[0], rotated[1], rotated[2] = x, y, np.cross(x, y)
    return rotated


@kernel()
def fit(camera, prior, xyz_mm, uv_px, variance_px2):
    """Return the least-squares camera for balls (n, 3) seen at pixels (n, 2) with covariances (n, 2, 2).

    With it: the precision (9, 9) of its parameters, chi-square with the priors' share, and half the sum of the log
    determinants of the covariances.
    """
    precision, gradient, chi2, half_log_det = _normal_equations(camera, prior, xyz_mm, uv_px, variance_px2)
    for _ in range(STEPS):
        step = np.linalg.solve(precision, gradient)
        camera = Camera(_rotated(camera.matrix, step[:3]), camera.middle_mm, camera.numbers + step[3:])
        precision, gradient, chi2, half_log_det = _normal_equations(camera, prior, xyz_mm, uv_px, variance_px2)
    return Fit(camera, precision, chi2, half_log_det)


GATE_M2 = 13.8  # 99.9 % of chi-square with two degrees of freedom [calc]
GATE_SD_PX = 4.0  # largest s.d. for which a gate is looked at, px [ours]
RADIUS_SD = 0.06  # of log radii: noise, blur [ours]
MISJUDGED = 0.05  # share of radii far off; 2 % in images with plates [twin]
LOG_RADII = 2.5  # range of log radii of false detections: log(25 / 2), px [calc]
ROUNDS, NARROWED = 12, 2  # of matching and fitting; the first ones within a gate in px
MIN_SCALE = 1e-6  # px/mm, of balls behind the source
LOG_SCALES = 3.0  # range of the log scale: log(10 / 0.5), px/mm [calc]
MIN_PAIRS = 4  # that determine a camera with the help of its priors [ours]


@dataclass(frozen=True, eq=False)
class Labelling:
    """Detections `rows` (n,) labelled as `balls` (n,), with the camera that fits them in the image or its mirror image.

    `unclear`: detections that may show two balls, or one of two that may show the same. `evidence`: minus the log of
    the chance that false detections match as well; `by_radius`: log likelihood ratio of the radii to false ones.
    `off_px` (n, 2): residuals.
    """

    rows: np.ndarray
    balls: np.ndarray
    unclear: np.ndarray
    fit: Fit
    mirrored: bool
    evidence: float
    by_radius: float
    off_px: np.ndarray

    @property
    def log_likelihood(self) -> float:
        """Log likelihood ratio to false detections, by which labellings of one image are compared."""
        return self.evidence + self.by_radius

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) from the balls' axes to the image's: right, down, along the beam; left-handed where mirrored."""
        return sign_of(self.mirrored)[:, None] * self.fit.camera.matrix

    @property
    def T_camera_cloud(self) -> RigidTransform:
        """The pose of the balls in the camera's coordinates: origin in the focal point, z along the beam."""
        matrix, middle_mm, (u, v, log_scale, log_focal, principal_u, principal_v) = self.fit.camera
        scale = np.exp(log_scale)
        at_mm = np.array([u - principal_u, v - principal_v, np.exp(log_focal)]) / scale
        return RigidTransform.from_components(at_mm - matrix @ middle_mm, Rotation.from_matrix(matrix))

    def is_same(self, other: "Labelling") -> bool:
        """Return whether two labellings agree on handedness and on most detections, and contradict on none."""
        mine, theirs = (
            dict(zip(labelling.rows.tolist(), labelling.balls.tolist(), strict=True)) for labelling in (self, other)
        )
        both = mine.keys() & theirs.keys()
        agree = all(mine[row] == theirs[row] for row in both)
        return self.mirrored == other.mirrored and agree and 2 * len(both) >= min(len(mine), len(theirs))


def converge(problem: Problem, start: Hypothesis, gate_px: float) -> Labelling | None:
    """Return the labelling to which matching and fitting converge from a hypothesis, or None.

    The first rounds match within `gate_px` and its half, later ones by the fit's covariance.
    """
    try:
        labelling = _converged(problem, start, gate_px)
    except np.linalg.LinAlgError:  # the camera runs away, and its precision becomes singular
        return None
    return labelling if labelling is not None and np.isfinite(labelling.evidence) else None


def _converged(problem: Problem, start: Hypothesis, gate_px: float) -> Labelling | None:
    """Return the result of `converge`. Raises LinAlgError."""
    uv_px, variance_px2 = problem.image(start.mirrored)
    camera = _camera(problem, start, uv_px[start.row])
    fitted: Fit | None = None
    rows = balls = unclear = np.zeros(0, np.int64)
    for turn in range(ROUNDS):
        before = rows, balls
        if fitted is None or turn < NARROWED:
            rows, balls = _nearest(problem, camera, uv_px, gate_px / (1 + turn))
        else:
            rows, balls, unclear = _within(problem, fitted, uv_px, variance_px2)
        if len(rows) < MIN_PAIRS:
            return None
        if turn > NARROWED and np.array_equal(before, (rows, balls)):
            break
        spread_px2 = variance_px2[rows] + _ball_variance(problem, project(camera, problem.xyz_mm[balls])[1])
        fitted = Fit(*fit(camera, problem.prior, problem.xyz_mm[balls], uv_px[rows], spread_px2))
        camera = fitted.camera
        if not np.isfinite(fitted.chi2):
            return None
    if fitted is None:
        return None
    at_px, scales, _ = project(camera, problem.xyz_mm[balls])
    return Labelling(
        rows=rows,
        balls=balls,
        unclear=unclear,
        fit=fitted,
        mirrored=start.mirrored,
        evidence=_log_evidence(fitted, problem.prior, len(rows), len(problem.xyz_mm), len(uv_px)),
        by_radius=_by_radius(problem.log_radius[rows] - problem.log_half[balls] - np.log(scales)),
        off_px=uv_px[rows] - at_px,
    )


def _camera(problem: Problem, start: Hypothesis, uv_px: np.ndarray) -> Camera:
    """Return the camera of a hypothesis, whose first ball is seen at `uv_px` (2,) in the image or its mirror image."""
    left, _, right = np.linalg.svd(start.matrix * sign_of(start.mirrored)[:, None])
    numbers = np.array([*uv_px, np.log(start.scale), np.log(start.focal_px), *problem.prior.principal_px])
    return Camera(left @ right, problem.xyz_mm[start.ball], numbers)


def _ball_variance(problem: Problem, scales: np.ndarray) -> np.ndarray:
    """Return the covariances (n, 2, 2), px², of the balls' own errors at n px/mm."""
    return (problem.ball_sd_mm * scales)[:, None, None] ** 2 * np.eye(2)


def _near(problem: Problem, scales: np.ndarray, squares: np.ndarray, gate_px: float) -> np.ndarray:
    """Return the squared distances (N, M), infinite beyond the gate and where the radius is not that of the ball."""
    size = np.abs(problem.log_radius[:, None] - problem.log_half - np.log(np.maximum(scales, MIN_SCALE)))
    return np.where((squares < gate_px**2) & (size < RADIUS_RATIO), squares, np.inf)


def _nearest(problem: Problem, camera: Camera, uv_px: np.ndarray, gate_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return detections and balls that are each other's nearest within the gate."""
    at_px, scales, _ = project(camera, problem.xyz_mm)
    squares = _near(problem, scales, cdist(uv_px, at_px, "sqeuclidean"), gate_px)
    rows, balls = np.arange(len(uv_px)), squares.argmin(axis=1)
    mutual = np.isfinite(squares[rows, balls]) & (squares.argmin(axis=0)[balls] == rows)
    return rows[mutual], balls[mutual]


def _within(
    problem: Problem, fitted: Fit, uv_px: np.ndarray, variance_px2: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return detections and balls that are each other's only candidates by the fit's covariance, and unclear ones."""
    at_px, scales, by = project(fitted.camera, problem.xyz_mm)
    squares = _near(problem, scales, cdist(uv_px, at_px, "sqeuclidean"), GATE_SD_PX * np.sqrt(GATE_M2))
    rows, balls = np.nonzero(np.isfinite(squares))
    spread = variance_px2[rows] + _ball_variance(problem, scales[balls])
    spread += by[balls] @ np.linalg.inv(fitted.precision) @ by[balls].transpose(0, 2, 1)
    off = (uv_px[rows] - at_px[balls])[:, :, None]
    inside = (off * np.linalg.solve(spread, off)).sum(axis=(1, 2)) < GATE_M2
    rows, balls = rows[inside], balls[inside]
    single = (np.bincount(rows)[rows] == 1) & (np.bincount(balls)[balls] == 1) if len(rows) else inside[:0]
    return rows[single], balls[single], np.unique(rows[~single])


def _by_radius(off: np.ndarray) -> float:
    """Return the log likelihood ratio, to false detections, of log radii `off` (n,) the expected ones."""
    like = np.exp(-0.5 * (off / RADIUS_SD) ** 2) / (RADIUS_SD * np.sqrt(2 * np.pi))
    return float(np.log((1 - MISJUDGED) * like * LOG_RADII + MISJUDGED).sum())


def _log_evidence(fitted: Fit, prior: Prior, matched: int, balls: int, detections: int) -> float:
    """Return minus the log of the chance that false detections alone match a cloud as well as this fit does.

    `prior`: of `prior_of`. The chance is the union bound over all labellings of `matched` of the balls: their number
    over the likelihood ratio of the fit (marginal over the camera, by Laplace's method) to detections spread evenly
    over the image, both hands.
    """
    area_px2 = float(np.prod(2.0 * prior.principal_px + 1.0))  # of the image, whose middle it is
    labellings = (
        gammaln(balls + 1) - gammaln(matched + 1) - gammaln(balls - matched + 1)
        + gammaln(detections + 1) - gammaln(detections - matched + 1) + np.log(2)
    )  # fmt: skip
    _, log_det = np.linalg.slogdet(fitted.precision)
    log_prior = -np.log(8 * np.pi**2 * area_px2 * LOG_SCALES)
    log_prior -= np.log(prior.log_focal_sd * prior.principal_sd_px**2) + 1.5 * np.log(2 * np.pi)
    occam = log_prior + PARAMETERS / 2 * np.log(2 * np.pi) - log_det / 2
    return matched * np.log(area_px2 / (2 * np.pi)) - fitted.half_log_det - fitted.chi2 / 2 + occam - labellings
