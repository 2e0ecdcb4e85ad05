"""The smooth method: plane map and focal point fitted jointly to the beads of both plates, without outlying beads.

The model of a bead with pixel u and frame coordinates X is

    y(X, F) = c(u) + g(u) + e

- F: focal point; y(X, F): projection of X from F onto the reference plane, mm, two coordinates;
- c: cubic polynomial, g: Gaussian process; their sum is the plane map;
- e: noise: the covariance of u propagated by d(c + g)/du, plus the frame's errors propagated by dy/dX.

The model is linear in c and g, and nearly linear in the parameters p and q of F (`Pencil`). `fit_jointly` therefore
makes four Gauss-Newton steps: two by ordinary least squares, one with isotropic and one with full weights. The frame's
shared errors are noise with a prior: they enter the weights and the covariance at the target, and are not estimated.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.calibration.maps.hull import well_conditioned
from sightline.calibration.maps.polynomial import Affine, derivatives
from sightline.calibration.maps.smooth import DEGREE, NOISE_SCALES_PX, Learned, PriorData, SmoothMap, learn
from sightline.calibration.plates.beads import Beads
from sightline.calibration.view import LineErrors, Pencil, Residuals, refuse_misplaced
from sightline.common.checks import FALSE_ALARM
from sightline.common.fitting import (
    Kriging,
    LeftOut,
    PlanarKriging,
    cholesky,
    least_squares,
    minimum_norm,
    monomials,
    solve_lower,
    terms,
    variance_ratio,
)
from sightline.common.geometry.covariance import block_diagonal
from sightline.common.threads import one_blas_thread
from sightline.errors import CalibrationRefusedError

# The cubic has 20 parameters and F 3: 16 beads leave nine degrees of freedom to test them; with fewer than 12 none is
# left [ours].
MIN_BEADS = 16
# More outliers than this, or than this share, mean a wrong frame, image or labelling, whose beads agree by chance only:
# leaving them out one by one would end with a map through the rest [ours].
MAX_WRONG = 6
MAX_WRONG_SHARE = 0.1
_CUBIC = terms(DEGREE)


@dataclass(frozen=True, eq=False)
class JointFit:
    """The smooth method's result: map and pencil, with what their joint covariance needs.

    `data_mm` (2N,): the beads projected onto the plane from F before the last step; `noise` (N, 2, 2): covariance of
    each bead's measurement there; `jacobian` (N, 2, 3): derivative of that projection by the beads.
    """

    beads: Beads
    pencil: Pencil
    map: SmoothMap
    learned: Learned
    solution: Kriging
    data_mm: np.ndarray
    noise: np.ndarray
    jacobian: np.ndarray

    @one_blas_thread
    def line_errors(self, uv_px: np.ndarray) -> LineErrors:
        """Return covariances and frame factor of the errors of F and of the lines of sight of pixels (N, 2)."""
        at = self.map.unit(uv_px)
        n, k = len(at), 2 * len(self.beads)
        design = np.zeros((3 + 2 * n, 2 * _CUBIC + 3))
        design[:3, -3:] = self.pencil.focal_point_by_pq
        design[3:, :-3] = twice(monomials(at, DEGREE))
        cross = np.zeros((3 + 2 * n, k))
        cross[3:] = twice(self.map.kernel(at, self.map.controls_unit))
        prior = np.zeros((3 + 2 * n, 3 + 2 * n))
        prior[3:, 3:] = twice(self.map.kernel(at, at))
        weights, total = self.solution.predict(design, cross, prior)
        x, y = np.ascontiguousarray(weights.T).reshape(-1, 2, len(weights)).transpose(1, 2, 0)
        noise = x * self.noise[:, 0, 0] @ x.T + y * self.noise[:, 1, 1] @ y.T
        mixed = x * self.noise[:, 0, 1] @ y.T
        noise += mixed + mixed.T
        frame_factor = -weights @ self._frame_response
        return LineErrors(noise, _without_negative(total - noise - frame_factor @ frame_factor.T), frame_factor)

    @cached_property
    def _frame_response(self) -> np.ndarray:
        """(2N, K): response of the data to the unit-variance errors of `Frame.error_factor`."""
        by_bead = self.beads.frame_factor().reshape(len(self.beads), 3, -1)
        return (self.jacobian @ by_bead).reshape(2 * len(self.beads), -1)

    def prediction_sigma(self, others: Beads) -> np.ndarray:
        """Return (M,): Mahalanobis distances of other beads from their predictions (two degrees of freedom each)."""
        xy = self.map.to_plane(others.uv_px)
        errors = self.line_errors(others.uv_px)
        total = errors.noise + errors.misfit + errors.frame_factor @ errors.frame_factor.T
        by_focal = self.pencil.by_pq(others.xyz_mm) @ np.linalg.inv(self.pencil.focal_point_by_pq)
        to_residual = np.concatenate([-by_focal.reshape(-1, 3), np.eye(2 * len(others))], axis=1)
        covariance = to_residual @ total @ to_residual.T + block_diagonal(
            pixel_noise_mm2(others, self.map.jacobian(others.uv_px), self.learned.noise_scale)
        )
        covariance += _propagated(others, self.pencil.by_point(others.xyz_mm))
        own = np.einsum("iaib->iab", covariance.reshape(len(xy), 2, len(xy), 2))
        residual = xy - self.pencil.project(others.xyz_mm)
        return np.sqrt(np.einsum("ia,ia->i", residual, np.linalg.solve(own, residual[..., None])[..., 0]))


@well_conditioned()
def fit_jointly(beads: Beads) -> JointFit:
    """Return plane map and focal point of the beads. Raises CalibrationRefusedError."""
    if len(beads) < MIN_BEADS:
        raise CalibrationRefusedError(
            f"{len(beads)} beads are seen; the smooth method needs at least {MIN_BEADS} on both plates together, "
            "60 or more are good: move the frame into the field, or use the localized method"
        )
    start = _Start.of(beads, _Start.of(beads, _first_pencil(beads)).pencil)
    data = _prior_data(start)
    learned = learn(data, NOISE_SCALES_PX if beads.covariance_px2 is None else None)
    kernel = learned.kernel(start.at, start.at)
    pencil, plane_map = _isotropic_step(start, data, learned, kernel)
    return _weighted_step(start, learned, kernel, pencil, plane_map.jacobian(beads.uv_px))


def _isotropic_step(start: "_Start", data: PriorData, learned: Learned, kernel: np.ndarray) -> tuple[Pencil, SmoothMap]:
    """Make one Gauss-Newton step with isotropic noise: x and y share one matrix, of a quarter of the size."""
    covariance = kernel.copy()
    np.einsum("ii->i", covariance)[:] += learned.noise_scale**2 * data.noise_mm2 + data.frame_mm2
    solution = PlanarKriging.of(covariance, data.data_mm, design=data.design, columns=data.shared)
    beads = start.beads
    moved = Pencil(beads.plane, start.pencil.pq - np.append(solution.theta[-1], solution.shared))
    refuse_misplaced(moved, beads.xyz_mm)
    return moved, SmoothMap(start.unit, learned.kernel, solution.theta[:-1], solution.dual, beads.uv_px)


def _weighted_step(
    start: "_Start", learned: Learned, kernel: np.ndarray, pencil: Pencil, slopes: np.ndarray
) -> JointFit:
    """Make one Gauss-Newton step with full weights; a second changes the result negligibly (tests)."""
    beads = start.beads
    (y, jacobian, _), by_pq = pencil.projected(beads.xyz_mm), pencil.by_pq(beads.xyz_mm)
    noise = pixel_noise_mm2(beads, slopes, learned.noise_scale)
    covariance = _propagated(beads, jacobian) + twice(kernel) + block_diagonal(noise)
    design = np.concatenate([twice(start.basis), -by_pq.reshape(-1, 3)], axis=1)
    solution = Kriging.of(design, covariance, y.reshape(-1, 1))
    theta = solution.theta[:, 0]
    moved = Pencil(beads.plane, pencil.pq + theta[-3:])
    refuse_misplaced(moved, beads.xyz_mm)
    cubic, dual = theta[:-3].reshape(_CUBIC, 2), solution.dual.reshape(-1, 2)
    plane_map = SmoothMap(start.unit, learned.kernel, cubic, dual, beads.uv_px)
    return JointFit(beads, moved, plane_map, learned, solution, y.reshape(-1), noise, jacobian)


@dataclass(frozen=True, eq=False)
class _Start:
    """A cubic and F fitted by ordinary least squares.

    `unit`: pixels to normalised pixels; `radius_mm`: length of the normalised unit on the plane; `at` (N, 2): the
    beads' normalised pixels; `basis` (N, 10): monomials there; `pencil`: F; `cubic` (10, 2): coefficients of `basis`;
    `design` (2N, 23): the design matrix, and `r` (23, 23) the lower factor of its normal equations.
    """

    beads: Beads
    unit: Affine
    radius_mm: float
    at: np.ndarray
    basis: np.ndarray
    pencil: Pencil
    cubic: np.ndarray
    design: np.ndarray
    r: np.ndarray

    @staticmethod
    def of(beads: Beads, pencil: Pencil) -> "_Start":
        """Return the result of one Gauss-Newton step from `pencil`."""
        y, by_pq = pencil.project(beads.xyz_mm), pencil.by_pq(beads.xyz_mm)
        unit, radius = Affine.fit(beads.uv_px, y)
        at = unit(beads.uv_px)
        basis = monomials(at, DEGREE)
        design = np.concatenate([twice(basis), -by_pq.reshape(-1, 3)], axis=1)
        theta, r = least_squares(design, y.reshape(-1))
        moved = Pencil(beads.plane, pencil.pq + theta[-3:])
        refuse_misplaced(moved, beads.xyz_mm)
        return _Start(beads, unit, radius, at, basis, moved, theta[:-3].reshape(_CUBIC, 2), design, r)

    def slopes(self) -> np.ndarray:
        """Return the derivative (N, 2, 2) of the cubic by the pixel, mm/px."""
        by_unit = [self.basis @ (by @ self.cubic) for by in derivatives(DEGREE)]
        return np.stack(by_unit, axis=-1) @ self.unit.matrix

    def fixed(self) -> np.ndarray:
        """Return orthonormal rows (23, 2N) that span the design matrix's columns."""
        return solve_lower(self.r, self.design.T)


def _first_pencil(beads: Beads) -> Pencil:
    """Return a first estimate of F. The XRII beads give an affine map from pixels to the plane.

    It maps each source-plate bead, at x and height h in the plane's axes, to y: y (1 - h q) = x - h p is linear in p
    and q.
    """
    xrii, source = beads.on_xrii, ~beads.on_xrii
    plane = beads.plane
    at = np.ones((len(beads), 3))
    at[:, :2] = beads.uv_px
    y = at[source] @ minimum_norm(at[xrii], plane.to_plane(beads.xyz_mm[xrii]))
    x, h = plane.to_plane(beads.xyz_mm[source]), plane.height_mm(beads.xyz_mm[source])
    design = np.zeros((len(y), 2, 3))
    design[:, 0, 0] = design[:, 1, 1] = -h
    design[:, :, 2] = h[:, None] * y
    return Pencil(plane, minimum_norm(design.reshape(-1, 3), (y - x).reshape(-1, 1))[:, 0])


def _prior_data(start: _Start) -> PriorData:
    """Return the data from which kernel and noise scale are learned, with isotropic noise for each bead."""
    beads = start.beads
    (y, by_point, _), by_pq = start.pencil.projected(beads.xyz_mm), start.pencil.by_pq(beads.xyz_mm)
    noise = pixel_noise_mm2(beads, start.slopes(), 1.0)
    own = (noise[:, 0, 0] + noise[:, 1, 1]) / 2
    frame_mm2 = _frame_variance(beads, by_point, start.fixed())
    common = np.column_stack([start.basis, by_pq[:, 0, 0]])
    return PriorData(start.at, common, by_pq[:, :, 2:], y, own, frame_mm2, start.radius_mm)


def _frame_variance(beads: Beads, jacobian: np.ndarray, fixed: np.ndarray) -> float:
    """Return the mean variance that the frame's errors add to a coordinate, outside the subspace `fixed` (m, 2N).

    Errors within that subspace are absorbed by the cubic and F, and do not affect the estimate of the kernel.
    """
    covariance = _propagated(beads, jacobian)
    absorbed = np.sum((fixed @ covariance) * fixed)
    return max(float(covariance.trace() - absorbed), 0.0) / max(fixed.shape[1] - fixed.shape[0], 1)


def _noise_px2(beads: Beads) -> np.ndarray:
    """Return (N, 2, 2): the beads' covariance, or the identity (1 px) where it is unknown."""
    if beads.covariance_px2 is not None:
        return beads.covariance_px2
    return np.broadcast_to(np.eye(2), (len(beads), 2, 2))


def pixel_noise_mm2(beads: Beads, slopes: np.ndarray, scale: float) -> np.ndarray:
    """Return the covariances (N, 2, 2), mm², of the beads' pixels propagated to the plane by `slopes` (N, 2, 2)."""
    return slopes @ (scale**2 * _noise_px2(beads)) @ np.swapaxes(slopes, 1, 2)


def _propagated(beads: Beads, jacobian: np.ndarray) -> np.ndarray:
    """Return the covariance (2N, 2N), mm², of J x for the errors x of the beads in the frame, and J (N, 2, 3)."""
    covariance = beads.frame_covariance.reshape(len(jacobian), 3, -1)
    half = (jacobian @ covariance).reshape(-1, len(jacobian), 3)
    return (half.transpose(1, 0, 2) @ jacobian.transpose(0, 2, 1)).transpose(1, 0, 2).reshape(len(half), -1)


def twice(matrix: np.ndarray) -> np.ndarray:
    """Return (2N, 2M): `matrix` (N, M) for x and for y, interleaved."""
    n, m = matrix.shape
    doubled = np.zeros((n, 2, m, 2))
    doubled[:, 0, :, 0] = doubled[:, 1, :, 1] = matrix
    return doubled.reshape(2 * n, 2 * m)


def _without_negative(matrix: np.ndarray) -> np.ndarray:
    """Return the nearest positive semi-definite matrix: rounding of a difference can give eigenvalues of -1e-16."""
    symmetric = 0.5 * (matrix + matrix.T)
    with suppress(np.linalg.LinAlgError):
        cholesky(symmetric)  # it succeeds for most, in a fifth of the time that the eigenvalues take
        return symmetric
    values, vectors = np.linalg.eigh(symmetric)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def fit_robustly(beads: Beads) -> tuple[JointFit, Residuals]:
    """Return the joint fit without outlying beads, and the residuals of all. Raises CalibrationRefusedError."""
    used = np.ones(len(beads), dtype=bool)
    limit = max(1, min(MAX_WRONG, int(MAX_WRONG_SHARE * len(beads))))
    while True:
        fit = fit_jointly(beads.where(used))
        others = fit.solution.left_out()
        square = others.m2
        # If all residuals are too large, the stated noise is too small: the chi-square check reports that.
        common = max(1.0, variance_ratio(square))
        worst = int(np.argmax(square))
        if square[worst] <= -2 * np.log(FALSE_ALARM / len(square)) * common:
            return fit, _residuals(fit, beads, used, others)
        if (~used).sum() == limit:
            wrong = [i for i, u in zip(beads.ids, used, strict=True) if not u]
            raise CalibrationRefusedError(
                f"more than {limit} beads contradict the others ({', '.join(wrong)} and {fit.beads.ids[worst]} first); "
                "check that frame, view and labels are right and that the frame is undamaged, then acquire another "
                "image"
            )
        used[np.flatnonzero(used)[worst]] = False


def _residuals(fit: JointFit, beads: Beads, used: np.ndarray, others: LeftOut) -> Residuals:
    """Return the residuals of every bead given; a bead that was left out is predicted by all that were used."""
    residual = fit.map.to_plane(beads.uv_px) - fit.pencil.project(beads.xyz_mm)
    loo, sigma = residual.copy(), np.zeros(len(beads))
    loo[used], sigma[used] = -others.residual, np.sqrt(np.maximum(others.m2, 0.0))
    if not used.all():
        sigma[~used] = fit.prediction_sigma(beads.where(~used))
    return Residuals(beads.ids, beads.uv_px, residual, loo, np.ones(len(beads), dtype=bool), sigma, used)
