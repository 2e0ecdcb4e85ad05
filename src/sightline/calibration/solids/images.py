"""One image of a solid of balls on a flat panel, as data of an adjustment; `plate_image` has an intensifier's."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from sightline.calibration.maps.hull import Hull
from sightline.calibration.solids.panel_camera import PARAMETERS, PanelCamera, PanelPrior
from sightline.calibration.view import PlaneMap
from sightline.common.geometry.planes import Plane

MIN_BALLS = 6  # of the solid in one image: 9 unknowns of its camera, two equations for each ball [ours]


@dataclass(frozen=True, eq=False)
class SolidBalls:
    """M balls: `xyz_mm` (M, 3); `radius_mm` (M,); `factor` (3M, K): their errors are factor @ e, e of unit variance
    (`Frame.error_factor`). The first `count` are the solid's, CFCS; others are those of a plate on the detector."""

    xyz_mm: np.ndarray
    radius_mm: np.ndarray
    factor: np.ndarray
    count: int

    @property
    def error_mm(self) -> float:
        """Rms of the balls' errors per axis."""
        return float(np.sqrt((self.factor**2).sum() / len(self.factor)))

    @property
    def middle_mm(self) -> np.ndarray:
        """(3,) mean of the solid's balls, CFCS."""
        return self.xyz_mm[: self.count].mean(axis=0)

    def by_e(self, rows: np.ndarray) -> np.ndarray:
        """Return (N, 3, K): derivative of the balls `rows` by e."""
        return self.factor.reshape(len(self.xyz_mm), 3, -1)[rows]

    def moved_mm(self, e: np.ndarray) -> np.ndarray:
        """Return (M, 3): the balls' positions with errors `e` (K,)."""
        return self.xyz_mm + (self.factor @ e).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class BallShadows:
    """N places in the camera's image, `at` (N, 2), with their derivatives by the camera's parameters, `by_camera`
    (N, 2, 9), and by the balls' errors, `by_e` (N, 2, K)."""

    at: np.ndarray
    by_camera: np.ndarray
    by_e: np.ndarray


@dataclass(frozen=True, eq=False)
class Traced(BallShadows):
    """N pixels taken to the camera's image. `jacobian` (N, 2, 2): by the pixels; `covariance` (2N, 2N): of what the map
    does not know, given camera and balls."""

    jacobian: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class SolidImage:
    """The balls of one image: centres `uv_px` (N, 2), `covariance_px2` (N, 2, 2), `rows` (N,) among all balls.

    A flat panel's image is the camera's, in pixels.
    """

    uv_px: np.ndarray
    covariance_px2: np.ndarray
    rows: np.ndarray
    prior: PanelPrior

    @cached_property
    def whiten(self) -> np.ndarray:
        """(N, 2, 2): takes residuals in px to unit covariance."""
        return np.linalg.inv(np.linalg.cholesky(self.covariance_px2))

    @property
    def data(self) -> int:
        """Number of the image's whitened data."""
        return self.uv_px.size

    @property
    def unit(self) -> str:
        """Unit of length in the camera's image."""
        return "px"

    @property
    def enough(self) -> bool:
        """Whether the balls determine a camera."""
        return len(self.rows) >= MIN_BALLS

    def undistorted(self) -> "SolidImage":
        """Return the image of the solid alone as a panel shows it, to begin with."""
        return self

    def without(self, ball: int) -> Self:
        """Return the image without one of its balls."""
        kept = np.arange(len(self.rows)) != ball
        return replace(self, uv_px=self.uv_px[kept], covariance_px2=self.covariance_px2[kept], rows=self.rows[kept])

    def shadows(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray, rows: np.ndarray) -> BallShadows:
        """Return the shadows of the balls `rows` (N,), with errors `e` (K,)."""
        at, by_camera, by_point = camera.shadows(solid.moved_mm(e)[rows], solid.radius_mm[rows])
        return BallShadows(at, by_camera, by_point @ solid.by_e(rows))

    def whitened(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the whitened residuals (R,), data minus model, and the whitened model's derivatives by the camera
        (R, 9) and by the balls' errors (R, K)."""
        uv, by_camera, by_point = camera.shadows(solid.moved_mm(e)[self.rows], solid.radius_mm[self.rows])
        return (
            (self.whiten @ (self.uv_px - uv)[..., None]).ravel(),
            (self.whiten @ by_camera).reshape(-1, PARAMETERS),
            (self.whiten @ by_point @ solid.by_e(self.rows)).reshape(uv.size, len(e)),
        )

    def left_out(self, residual: np.ndarray, design: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `SolidAdjustment.left_out` from whitened residuals (R,), their design (R, C) and gain (C, R)."""
        residual = residual.reshape(-1, 2)
        hat = np.einsum("nak,knb->nab", design.reshape(len(residual), 2, -1), gain.reshape(-1, len(residual), 2))
        alone = np.linalg.solve(np.eye(2) - hat, residual[..., None])[..., 0]
        back = np.linalg.inv(self.whiten)
        return np.einsum("nab,nb->na", back, alone), np.einsum("na,na->n", residual, alone)

    def traced(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray, uv_px: np.ndarray) -> Traced:
        """Return the places of pixels (N, 2) in the camera's image: themselves."""
        n = len(uv_px)
        return Traced(
            uv_px,
            np.zeros((n, 2, PARAMETERS)),
            np.zeros((n, 2, len(e))),
            np.broadcast_to(np.eye(2), (n, 2, 2)),
            np.zeros((2 * n, 2 * n)),
        )

    def plane_map(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray, plane: Plane) -> PlaneMap:
        """Return the map between the image and a plane, CFCS."""
        return camera.plane_map(plane)

    def hull(self, shape: tuple[int, int] | None) -> Hull:
        """Return the calibrated region of an image of this shape: all of it."""
        assert shape is not None  # noqa: S101 - `solid_start.image_of` refuses it
        height, width = shape
        return Hull.of(np.array([[0.0, 0.0], [width - 1, 0.0], [width - 1, height - 1], [0.0, height - 1]]))

    def is_mirrored(self, camera: PanelCamera) -> bool:
        """Whether the image shows the solid as its mirror image."""
        return camera.mirrored

    def placed_mm(self, camera: PanelCamera, xyz_mm: np.ndarray) -> np.ndarray:
        """Return where all balls at (M, 3) in the frame's file are, CFCS."""
        return xyz_mm
