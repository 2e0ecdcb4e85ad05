"""Joint adjustment of all images of a solid of balls on flat panels.

The unknowns are each image's camera (pose, focal length, principal point) and the errors of the balls, which all images
share. The data are the balls' centres, and priors of the focal lengths, the principal points and the balls' errors. All
are weighted by their covariances; Gauss-Newton steps give the maximum a posteriori and its covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.calibration.panel import CENTRE, FOCAL, PARAMETERS, PanelCamera
from sightline.errors import CalibrationRefusedError
from sightline.fitting.triangular import cholesky, solve_lower, solve_lower_transposed
from sightline.geometry.planes import Plane

MIN_BALLS = 6  # of one image: 9 unknowns of its camera, two equations for each ball [ours]
_STEPS = 50  # at most; from scaled orthography four suffice, of the right handedness
_HALVINGS = 10  # at most, of a step that would increase the misfit
_CONVERGED = 1e-8  # of chi-square, still to be gained: a step of 1e-4 standard deviations


@dataclass(frozen=True)
class PanelPrior:
    """What is known of a panel before its image is calibrated, with standard deviations.

    `focal_px` and `focal_share`, relative; `centre_px` (u, v) and `centre_sd_px`, per axis.
    """

    focal_px: float
    focal_share: float
    centre_px: tuple[float, float]
    centre_sd_px: float


@dataclass(frozen=True, eq=False)
class SolidImage:
    """The balls of one image: centres `uv_px` (N, 2), `covariance_px2` (N, 2, 2), `rows` (N,) among the solid's."""

    uv_px: np.ndarray
    covariance_px2: np.ndarray
    rows: np.ndarray
    prior: PanelPrior

    @cached_property
    def whiten(self) -> np.ndarray:
        """(N, 2, 2): takes residuals in px to unit covariance."""
        return np.linalg.inv(np.linalg.cholesky(self.covariance_px2))

    def without(self, ball: int) -> "SolidImage":
        """Return the image without one of its balls."""
        kept = np.arange(len(self.rows)) != ball
        return SolidImage(self.uv_px[kept], self.covariance_px2[kept], self.rows[kept], self.prior)


@dataclass(frozen=True, eq=False)
class SolidBalls:
    """M balls: `xyz_mm` (M, 3), CFCS; `radius_mm` (M,); `factor` (3M, K): their errors are factor @ e, e of unit
    variance (`Frame.error_factor`)."""

    xyz_mm: np.ndarray
    radius_mm: np.ndarray
    factor: np.ndarray

    @property
    def error_mm(self) -> float:
        """Rms of the balls' errors per axis."""
        return float(np.sqrt((self.factor**2).sum() / len(self.factor)))


@dataclass(frozen=True, eq=False)
class SolidAdjustment:
    """The maximum a posteriori of V images: `cameras`, and the solid's errors `e` (K,) in standard deviations.

    `residual` (R,) and `design` (R, K + 9V): of the whitened data, columns e first. The rows are two for each ball of
    the first image, of the second, and so on; then those of the priors: three for each camera, K of e.
    """

    solid: SolidBalls
    images: tuple[SolidImage, ...]
    cameras: tuple[PanelCamera, ...]
    e: np.ndarray
    residual: np.ndarray
    design: np.ndarray

    @property
    def xyz_mm(self) -> np.ndarray:
        """(M, 3) adjusted positions of the balls, CFCS."""
        return self.solid.xyz_mm + (self.solid.factor @ self.e).reshape(-1, 3)

    @property
    def freedom(self) -> int:
        """Number of data minus that of parameters."""
        return self.design.shape[0] - self.design.shape[1]

    @property
    def chi_square(self) -> float:
        """Squared length of the whitened residuals, priors included."""
        return float(self.residual @ self.residual)

    @cached_property
    def gain(self) -> np.ndarray:
        """(K + 9V, R): response of the estimates to unit-variance errors of the whitened data."""
        factor = cholesky(self.design.T @ self.design)
        return solve_lower_transposed(factor, solve_lower(factor, np.ascontiguousarray(self.design.T)))

    def rows_of(self, image: int) -> slice:
        """Return the rows of an image's balls."""
        start = 2 * sum(len(one.rows) for one in self.images[:image])
        return slice(start, start + 2 * len(self.images[image].rows))

    def columns_of(self, image: int) -> slice:
        """Return the columns of an image's camera."""
        start = len(self.e) + PARAMETERS * image
        return slice(start, start + PARAMETERS)

    def left_out(self, image: int) -> tuple[np.ndarray, np.ndarray]:
        """Return each ball's residual (N, 2), px, against its prediction by all other data, and that residual's
        squared Mahalanobis length (N,)."""
        rows = self.rows_of(image)
        residual = self.residual[rows].reshape(-1, 2)
        hat = np.einsum(
            "nak,knb->nab",
            self.design[rows].reshape(len(residual), 2, -1),
            self.gain[:, rows].reshape(-1, len(residual), 2),
        )
        alone = np.linalg.solve(np.eye(2) - hat, residual[..., None])[..., 0]
        back = np.linalg.inv(self.images[image].whiten)
        return np.einsum("nab,nb->na", back, alone), np.einsum("na,na->n", residual, alone)

    def prediction(
        self, image: int, uv_px: np.ndarray, rows: np.ndarray, covariance_px2: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N, 2), px, of balls in an image that were not used, and their lengths (N,) in s.d."""
        uv, by_camera, by_point = self.cameras[image].shadows(self.xyz_mm[rows], self.solid.radius_mm[rows])
        response = by_camera @ self.gain[self.columns_of(image)]
        response += by_point @ self.solid.factor.reshape(-1, 3, len(self.e))[rows] @ self.gain[: len(self.e)]
        covariance = covariance_px2 + response @ np.swapaxes(response, 1, 2)
        residual = uv_px - uv
        along = np.linalg.solve(covariance, residual[..., None])[..., 0]
        return residual, np.sqrt(np.einsum("na,na->n", residual, along))

    def score(self, direction: np.ndarray) -> float:
        """Return by how many standard deviations the data want a parameter that moves them along `direction` (R,)."""
        free = direction - self.design @ (self.gain @ direction)
        return float(free @ self.residual / np.sqrt(free @ direction))

    def responses(self, image: int, plane: Plane, uv_px: np.ndarray) -> dict[str, np.ndarray]:
        """Return for each source (3 + 2N, columns) the response of focal point and lines of sight of an image's pixels
        (N, 2) to its independent unit-variance errors: the balls' centres, the panels' priors, the solid."""
        lines = self.cameras[image].lines_by_parameters(plane, uv_px) @ self.gain[self.columns_of(image)]
        balls = 2 * sum(len(one.rows) for one in self.images)
        panels = balls + 3 * len(self.images)
        return {"beads": lines[:, :balls], "focal_point": lines[:, balls:panels], "frame": -lines[:, panels:]}


def adjust(solid: SolidBalls, images: Sequence[SolidImage], cameras: Sequence[PanelCamera]) -> SolidAdjustment:
    """Return the adjustment of images, begun at approximate cameras. Raises CalibrationRefusedError."""
    found, converged = descend(solid, images, cameras, _STEPS)
    if not converged:
        raise CalibrationRefusedError(
            "the balls' images do not determine the views: the adjustment does not converge; check the labels, and "
            "that the frame file describes the solid in the images"
        )
    return found


def descend(
    solid: SolidBalls, images: Sequence[SolidImage], cameras: Sequence[PanelCamera], steps: int
) -> tuple[SolidAdjustment, bool]:
    """Return the adjustment after at most so many steps, and whether it has converged."""
    now = _linearised(solid, images, cameras, np.zeros(solid.factor.shape[1]))
    for _ in range(steps):
        step = now.gain @ now.residual
        better = None if now.residual @ (now.design @ step) <= _CONVERGED else _shortened(now, step)
        if better is None:
            return now, True
        now = better
    return now, False


def _shortened(now: SolidAdjustment, step: np.ndarray) -> SolidAdjustment | None:
    """Return the adjustment after the longest of the halved steps that decreases the misfit, None if none does."""
    for _ in range(_HALVINGS):
        cameras = [camera.moved(step[now.columns_of(k)]) for k, camera in enumerate(now.cameras)]
        e = now.e + step[: len(now.e)]
        xyz = now.solid.xyz_mm + (now.solid.factor @ e).reshape(-1, 3)
        if all(camera.in_front(xyz) for camera in cameras):
            moved = _linearised(now.solid, now.images, cameras, e)
            if moved.chi_square < now.chi_square:
                return moved
        step = step / 2
    return None


def _linearised(
    solid: SolidBalls, images: Sequence[SolidImage], cameras: Sequence[PanelCamera], e: np.ndarray
) -> SolidAdjustment:
    """Return residuals (data minus model) and design at given parameters."""
    size, balls = len(e) + PARAMETERS * len(images), sum(2 * len(one.rows) for one in images)
    residual = np.zeros(balls + 3 * len(images) + len(e))
    design = np.zeros((len(residual), size))
    xyz = solid.xyz_mm + (solid.factor @ e).reshape(-1, 3)
    by_e = solid.factor.reshape(len(xyz), 3, len(e))
    start = 0
    for k, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        uv, by_camera, by_point = camera.shadows(xyz[image.rows], solid.radius_mm[image.rows])
        rows, own = slice(start, start + uv.size), len(e) + PARAMETERS * k
        residual[rows] = (image.whiten @ (image.uv_px - uv)[..., None]).ravel()
        design[rows, own : own + PARAMETERS] = (image.whiten @ by_camera).reshape(-1, PARAMETERS)
        design[rows, : len(e)] = (image.whiten @ by_point @ by_e[image.rows]).reshape(uv.size, len(e))
        start += uv.size
        prior, at = image.prior, balls + 3 * k
        residual[at] = -np.log(camera.focal_px / prior.focal_px) / prior.focal_share
        residual[at + 1 : at + 3] = (np.array(prior.centre_px) - camera.centre_px) / prior.centre_sd_px
        design[at, own + FOCAL] = 1.0 / prior.focal_share
        design[range(at + 1, at + 3), range(own + CENTRE.start, own + CENTRE.stop)] = 1.0 / prior.centre_sd_px
    known = balls + 3 * len(images)
    residual[known:] = -e
    design[known:, : len(e)] = np.eye(len(e))
    return SolidAdjustment(solid, tuple(images), tuple(cameras), e, residual, design)
