"""One image of a solid of balls on an image intensifier, with a plate of balls on its detector.

In the plate's plane the image is a central projection without distortion: that of a camera whose focal length and
principal point are the focal point's position against the plate, in mm. The map from pixels to that plane is that of
the smooth method: a cubic c and a Gaussian process g. For each ball, of the plate or of the solid,

    shadow on the plate(camera, errors of the balls) = c(u) + g(u) + noise

The cubic has no prior. So the data are the combinations of all shadows that no cubic changes, whitened by the
covariance of g and of the noise.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.calibration.maps.hull import Hull
from sightline.calibration.maps.polynomial import monomials
from sightline.calibration.maps.smooth import DEGREE, FittedSmoothMap, SmoothMap
from sightline.calibration.matrix_view import HomographyMap
from sightline.calibration.plates.joint import twice
from sightline.calibration.solids.images import MIN_BALLS, BallShadows, SolidBalls, SolidImage, Traced
from sightline.calibration.solids.panel_camera import CENTRE, FOCAL, PARAMETERS, PanelCamera
from sightline.calibration.view import PlaneMap
from sightline.common.fitting import Kriging, cholesky, inverse_lower
from sightline.common.geometry.planes import Plane

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
class ThroughPlate:
    """A `PlaneMap` by way of the plate: `plate_map` takes pixels to its plane, `beyond` from there to another."""

    plate_map: SmoothMap
    beyond: HomographyMap

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2)."""
        return self.beyond.to_plane(self.plate_map.to_plane(uv_px))

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of plane coordinates (N, 2). Raises OutsideRegionError."""
        return self.plate_map.to_image(self.beyond.to_image(xy_mm))

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) that have one, and which do, (N,) bool."""
        on_plate, regular = self.beyond.find_image(xy_mm)
        uv, regular[regular] = self.plate_map.find_image(on_plate)
        return uv, regular

    def jacobian(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, 2, 2) d xy / d uv, mm/px."""
        return self.linearised(uv_px)[1]

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`."""
        on_plate, first = self.plate_map.linearised(uv_px)
        xy, second = self.beyond.linearised(on_plate)
        return xy, second @ first
