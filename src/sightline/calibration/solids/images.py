"""One image of a solid of balls on a flat panel, as data of an adjustment; `plate_image` has an intensifier's."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from sightline.calibration.maps.hull import Hull
from sightline.calibration.maps.smooth import DEGREE, FittedSmoothMap, SmoothMap
from sightline.calibration.matrix_view import HomographyMap
from sightline.calibration.plates.joint import twice
from sightline.calibration.solids.panel_camera import CENTRE, FOCAL, PARAMETERS, PanelCamera, PanelPrior
from sightline.calibration.view import PlaneMap
from sightline.common.fitting import Kriging, cholesky, inverse_lower, monomials
from sightline.common.geometry.planes import Plane

MIN_BALLS = 6  # of the solid in one image: 12 equations for the 9 unknowns of its camera [calc]


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


MIN_PLATE_BALLS = 12  # in one image: two more than the cubic's ten unknowns of each coordinate


@dataclass(frozen=True, eq=False)
class DetectorPlateImage(SolidImage):
    """The balls of one image, solid's and plate's. `count`: of the solid, the first rows; `plane`: of the plate, in its
    own coordinates; `start`: the map fitted to the plate alone, whose process and derivative are kept."""

    count: int
    plane: Plane
    start: FittedSmoothMap

    @property
    def data(self) -> int:
        """Number of the image's whitened data."""
        return len(self._contrasts)

    @property
    def unit(self) -> str:
        """Unit of length in the camera's image."""
        return "mm"

    @property
    def on_plate(self) -> np.ndarray:
        """(N,) bool: the plate's balls."""
        return self.rows >= self.count

    @property
    def enough(self) -> bool:
        """Whether the balls determine map and camera."""
        return (~self.on_plate).sum() >= MIN_BALLS and self.on_plate.sum() >= MIN_PLATE_BALLS

    def undistorted(self) -> SolidImage:
        """Return the image of the solid alone in the plate's plane, mm, by the plate's own map."""
        mine = ~self.on_plate
        xy, jacobian = self.start.linearised(self.uv_px[mine])
        noise = jacobian @ self.covariance_px2[mine] @ np.swapaxes(jacobian, 1, 2)
        noise = noise + np.diag(self.start.covariance_mm2(self.uv_px[mine]))[:, None, None] * np.eye(2)
        return SolidImage(xy, noise, self.rows[mine], self.prior)

    def shadows(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray, rows: np.ndarray) -> BallShadows:
        """Return the shadows on the plate's plane, mm, of the balls `rows` (N,), with errors `e` (K,)."""
        plate, xyz = rows >= self.count, solid.moved_mm(e)[rows]
        beyond = camera.shadows(xyz[~plate], solid.radius_mm[rows[~plate]])
        here = self._plate_shadows(camera, xyz[plate])
        parts = []
        for of_solid, of_plate in zip(beyond, here, strict=True):
            both = np.empty((len(rows), *of_solid.shape[1:]))
            both[~plate], both[plate] = of_solid, of_plate
            parts.append(both)
        at, by_camera, by_point = parts
        return BallShadows(at, by_camera, by_point @ solid.by_e(rows))

    def _plate_shadows(self, camera: PanelCamera, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the shadows (N, 2) of balls at or near the plate's plane, with their derivatives by the camera
        (N, 2, 9) and by the balls (N, 2, 3)."""
        off, height = self.plane.to_plane(xyz_mm) - camera.centre_px, self.plane.height_mm(xyz_mm)
        reach = (camera.focal_px / (camera.focal_px - height))[:, None]
        by_camera = np.zeros((len(off), 2, PARAMETERS))
        by_camera[:, :, FOCAL] = (reach - reach**2) * off
        by_camera[:, range(2), range(CENTRE.start, CENTRE.stop)] = 1.0 - reach
        lift = (reach**2 / camera.focal_px * off)[:, :, None] * self.plane.normal
        return camera.centre_px + reach * off, by_camera, reach[:, :, None] * self.plane.axes + lift

    def plane_map(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray, plane: Plane) -> PlaneMap:
        """Return the map between the image and a plane, CFCS."""
        return ThroughPlate(self.plate_map(camera, solid, e), camera.plane_map(plane))

    def hull(self, shape: tuple[int, int] | None) -> Hull:
        """Return the calibrated region: that of the plate."""
        return Hull.of(self.uv_px[self.on_plate])

    def is_mirrored(self, camera: PanelCamera) -> bool:
        """Whether the image shows the solid as its mirror image."""
        return camera.mirrored != bool(np.linalg.det(self.start.unit.matrix) < 0)

    def placed_mm(self, camera: PanelCamera, xyz_mm: np.ndarray) -> np.ndarray:
        """Return where all balls at (M, 3) in the frame's file are, CFCS; the plate's by this image."""
        plate = xyz_mm[self.count :]
        x, y = (self.plane.to_plane(plate) - camera.centre_px).T
        there = np.stack([-x if camera.mirrored else x, y, camera.focal_px - self.plane.height_mm(plate)], axis=1)
        return np.concatenate([xyz_mm[: self.count], (there - camera.translation_mm) @ camera.rotation])

    @cached_property
    def _design(self) -> np.ndarray:
        """(2N, 20): the cubic's columns."""
        return twice(monomials(self.start.unit(self.uv_px), DEGREE))

    @cached_property
    def _covariance(self) -> np.ndarray:
        """(2N, 2N), mm², of g and of the noise of the balls' images."""
        at, slopes, n = self.start.unit(self.uv_px), self.start.jacobian(self.uv_px), len(self.rows)
        covariance = twice(self.start.kernel(at, at)).reshape(n, 2, n, 2)
        covariance[range(n), :, range(n), :] += slopes @ self.covariance_px2 @ np.swapaxes(slopes, 1, 2)
        return covariance.reshape(2 * n, 2 * n)

    @cached_property
    def _contrasts(self) -> np.ndarray:
        """(2N - 20, 2N): combinations of unit covariance that no cubic changes."""
        back = inverse_lower(cholesky(self._covariance))
        return np.linalg.qr(back @ self._design, mode="complete")[0][:, self._design.shape[1] :].T @ back

    def whitened(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return `SolidImage.whitened`; the data are zero."""
        model = self.shadows(camera, solid, e, self.rows)
        return (
            -self._contrasts @ model.at.ravel(),
            self._contrasts @ model.by_camera.reshape(-1, PARAMETERS),
            self._contrasts @ model.by_e.reshape(-1, len(e)),
        )

    def left_out(self, residual: np.ndarray, design: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `SolidAdjustment.left_out`, mm on the plate: by the precision of each shadow."""
        n = len(self.rows)
        rest = (self._contrasts - design @ (gain @ self._contrasts)).reshape(-1, n, 2)
        precision = np.einsum("rna,rnb->nab", self._contrasts.reshape(-1, n, 2), rest)
        pull = (residual @ self._contrasts).reshape(n, 2)
        alone = np.linalg.solve(precision, pull[..., None])[..., 0]
        return alone, np.einsum("na,na->n", pull, alone)

    def plate_map(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray) -> FittedSmoothMap:
        """Return the map from pixels to the plate's plane that all balls' shadows give."""
        shadows = self.shadows(camera, solid, e, self.rows)
        solution = Kriging.of(self._design, self._covariance, shadows.at.reshape(-1, 1))
        cubic, dual = solution.theta.reshape(-1, 2), solution.dual.reshape(-1, 2)
        return FittedSmoothMap(self.start.unit, self.start.kernel, cubic, dual, self.uv_px, solution)

    def traced(self, camera: PanelCamera, solid: SolidBalls, e: np.ndarray, uv_px: np.ndarray) -> Traced:
        """Return the places of pixels (N, 2) on the plate's plane, mm."""
        plate_map, shadows = self.plate_map(camera, solid, e), self.shadows(camera, solid, e, self.rows)
        xy, jacobian = plate_map.linearised(uv_px)
        at, n = plate_map.unit(uv_px), len(uv_px)
        weights, covariance = plate_map.solution.predict(
            twice(monomials(at, DEGREE)),
            twice(plate_map.kernel(at, plate_map.controls_unit)),
            twice(plate_map.kernel(at, at)),
        )
        by_camera, by_e = (
            weights @ derivative.reshape(len(self._design), -1) for derivative in (shadows.by_camera, shadows.by_e)
        )
        return Traced(xy, by_camera.reshape(n, 2, -1), by_e.reshape(n, 2, -1), jacobian, covariance)


@dataclass(frozen=True, eq=False)
class ThroughPlate(PlaneMap):
    """A map by way of the plate: `plate_map` takes pixels to its plane, `beyond` from there to another."""

    plate_map: SmoothMap
    beyond: HomographyMap

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of plane coordinates (N, 2). Raises OutsideRegionError."""
        return self.plate_map.to_image(self.beyond.to_image(xy_mm))

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) that have one, and which do, (N,) bool."""
        on_plate, regular = self.beyond.find_image(xy_mm)
        uv, regular[regular] = self.plate_map.find_image(on_plate)
        return uv, regular

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`."""
        on_plate, first = self.plate_map.linearised(uv_px)
        xy, second = self.beyond.linearised(on_plate)
        return xy, second @ first
