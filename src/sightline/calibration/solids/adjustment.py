"""Joint adjustment of all images of a solid of balls.

The unknowns are each image's camera (pose, focal length, principal point) and the errors of the balls, which all images
share. The data are the balls' centres, and priors of the focal lengths, the principal points and the balls' errors. All
are weighted by their covariances; Gauss-Newton steps give the maximum a posteriori and its covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.calibration.solids.images import SolidBalls, SolidImage, Traced
from sightline.calibration.solids.panel_camera import CENTRE, FOCAL, PARAMETERS, PanelCamera
from sightline.common.fitting import cholesky, solve_lower, solve_lower_transposed
from sightline.common.geometry.planes import Plane
from sightline.errors import CalibrationRefusedError

_STEPS = 50  # at most; from scaled orthography four suffice, of the right handedness
_HALVINGS = 10  # at most, of a step that would increase the misfit
_CONVERGED = 1e-8  # of chi-square, still to be gained: a step of 1e-4 standard deviations


@dataclass(frozen=True, eq=False)
class SolidAdjustment:
    """The maximum a posteriori of V images: `cameras`, and the solid's errors `e` (K,) in standard deviations.

    `residual` (R,) and `design` (R, K + 9V): of the whitened data, columns e first. The rows are those of the first
    image's balls (`SolidImage.whitened`), of the second's, and so on; then those of the priors: three for each camera,
    K of e.
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
        return self.solid.moved_mm(self.e)

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
        start = sum(image_k.data for image_k in self.images[:image])
        return slice(start, start + self.images[image].data)

    def columns_of(self, image: int) -> slice:
        """Return the columns of an image's camera."""
        start = len(self.e) + PARAMETERS * image
        return slice(start, start + PARAMETERS)

    def left_out(self, image: int) -> tuple[np.ndarray, np.ndarray]:
        """Return each ball's residual (N, 2), in the unit of the camera's image, against its prediction by all other
        data, and that residual's squared Mahalanobis length (N,)."""
        rows = self.rows_of(image)
        return self.images[image].left_out(self.residual[rows], self.design[rows], self.gain[:, rows])

    def traced(self, image: int, uv_px: np.ndarray) -> Traced:
        """Return where the pixels (N, 2) of an image are in its camera's."""
        return self.images[image].traced(self.cameras[image], self.solid, self.e, uv_px)

    def prediction(
        self, image: int, uv_px: np.ndarray, rows: np.ndarray, covariance_px2: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N, 2), in the unit of the camera's image, of balls in an image that were not used, and
        their lengths (N,) in s.d."""
        pixels = self.traced(image, uv_px)
        model = self.images[image].shadows(self.cameras[image], self.solid, self.e, rows)
        response = (model.by_camera - pixels.by_camera) @ self.gain[self.columns_of(image)]
        response += (model.by_e - pixels.by_e) @ self.gain[: len(self.e)]
        covariance = pixels.jacobian @ covariance_px2 @ np.swapaxes(pixels.jacobian, 1, 2)
        covariance = covariance + response @ np.swapaxes(response, 1, 2)
        covariance += np.einsum("nanb->nab", pixels.covariance.reshape(len(rows), 2, len(rows), 2))
        residual = pixels.at - model.at
        along = np.linalg.solve(covariance, residual[..., None])[..., 0]
        return residual, np.sqrt(np.einsum("na,na->n", residual, along))

    def score(self, direction: np.ndarray) -> float:
        """Return by how many standard deviations the data want a parameter that moves them along `direction` (R,)."""
        free = direction - self.design @ (self.gain @ direction)
        return float(free @ self.residual / np.sqrt(free @ direction))

    def responses(self, image: int, plane: Plane, uv_px: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return for each source (3 + 2N, columns) the response of focal point and lines of sight of an image's pixels
        (N, 2) to its independent unit-variance errors: the balls' centres, the panels' priors, the frame. And the
        covariance (3 + 2N, 3 + 2N) of what the image's map does not know at the pixels."""
        camera, pixels = self.cameras[image], self.traced(image, uv_px)
        lines = camera.lines_by_parameters(plane, pixels.at) @ self.gain[self.columns_of(image)]
        slopes = camera.plane_map(plane).jacobian(pixels.at)
        through = pixels.by_camera @ self.gain[self.columns_of(image)] + pixels.by_e @ self.gain[: len(self.e)]
        lines[3:] += (slopes @ through).reshape(2 * len(uv_px), lines.shape[1])
        onward = np.zeros((len(lines), 2 * len(uv_px)))
        for k, slope in enumerate(slopes):
            onward[3 + 2 * k : 5 + 2 * k, 2 * k : 2 * k + 2] = slope
        balls = sum(image_k.data for image_k in self.images)
        panels = balls + 3 * len(self.images)
        shared = {"beads": lines[:, :balls], "focal_point": lines[:, balls:panels], "frame": -lines[:, panels:]}
        return shared, onward @ pixels.covariance @ onward.T


def adjust(solid: SolidBalls, images: Sequence[SolidImage], cameras: Sequence[PanelCamera]) -> SolidAdjustment:
    """Return the adjustment of images, begun at approximate cameras. Raises CalibrationRefusedError."""
    fit, converged = iterated(solid, images, cameras)
    if not converged:
        raise CalibrationRefusedError(
            "the balls' images do not determine the views: the adjustment does not converge; check the labels, that "
            "the frame file describes the solid in the images, and that they are a flat panel's: an image intensifier "
            "needs a plate on the detector"
        )
    return fit


def iterated(
    solid: SolidBalls, images: Sequence[SolidImage], cameras: Sequence[PanelCamera]
) -> tuple[SolidAdjustment, bool]:
    """Return the adjustment after at most _STEPS, and whether it converged."""
    now = _linearised(solid, images, cameras, np.zeros(solid.factor.shape[1]))
    for _ in range(_STEPS):
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
        xyz = now.solid.moved_mm(e)[: now.solid.count]
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
    size, balls = len(e) + PARAMETERS * len(images), sum(image_k.data for image_k in images)
    residual = np.zeros(balls + 3 * len(images) + len(e))
    design = np.zeros((len(residual), size))
    start = 0
    for k, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        rows, own = slice(start, start + image.data), len(e) + PARAMETERS * k
        residual[rows], design[rows, own : own + PARAMETERS], design[rows, : len(e)] = image.whitened(camera, solid, e)
        start += image.data
        prior, at = image.prior, balls + 3 * k
        residual[at] = -np.log(camera.focal_px / prior.focal_px) / prior.focal_share
        residual[at + 1 : at + 3] = (np.array(prior.centre_px) - camera.centre_px) / prior.centre_sd_px
        design[at, own + FOCAL] = 1.0 / prior.focal_share
        design[range(at + 1, at + 3), range(own + CENTRE.start, own + CENTRE.stop)] = 1.0 / prior.centre_sd_px
    known = balls + 3 * len(images)
    residual[known:] = -e
    design[known:, : len(e)] = np.eye(len(e))
    return SolidAdjustment(solid, tuple(images), tuple(cameras), e, residual, design)
