"""Joint adjustment of all images of a solid of balls.

The unknowns are each image's camera (pose, focal length, principal point) and the errors of the balls, which all images
share. The data are the balls' centres, and priors of the focal lengths, the principal points and the balls' errors. All
are weighted by their covariances; Gauss-Newton steps give the maximum a posteriori and its covariance.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from sightline.calibration.lengths import CArm
from sightline.calibration.maps.hull import refuse_collinear
from sightline.calibration.maps.polynomial import Affine
from sightline.calibration.maps.smooth import FittedSmoothMap
from sightline.calibration.plates.beads import UNKNOWN_NOISE_PX
from sightline.calibration.solids.images import (
    MIN_BALLS,
    MIN_PLATE_BALLS,
    DetectorPlateImage,
    SolidBalls,
    SolidImage,
    Traced,
)
from sightline.calibration.solids.panel_camera import CENTRE, FOCAL, PARAMETERS, PanelCamera, PanelPrior
from sightline.common.fitting import cholesky, solve_lower, solve_lower_transposed
from sightline.common.geometry.planes import Plane
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame

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
    return descended(_linearised(solid, images, cameras, np.zeros(solid.factor.shape[1])), _moved)


_Adjustment = TypeVar("_Adjustment", bound=SolidAdjustment)
Moved = Callable[[_Adjustment, np.ndarray], _Adjustment | None]


def descended(now: _Adjustment, moved: Moved[_Adjustment]) -> tuple[_Adjustment, bool]:
    """Return an adjustment after at most _STEPS Gauss-Newton steps, and whether it converged.

    `moved`: the adjustment at parameters changed by a step; None where they have no images.
    """
    for _ in range(_STEPS):
        step = now.gain @ now.residual
        better = None if now.residual @ (now.design @ step) <= _CONVERGED else _shortened(now, step, moved)
        if better is None:
            return now, True
        now = better
    return now, False


def _shortened(now: _Adjustment, step: np.ndarray, moved: Moved[_Adjustment]) -> _Adjustment | None:
    """Return the adjustment after the longest of the halved steps that decreases the misfit, None if none does."""
    for _ in range(_HALVINGS):
        there = moved(now, step)
        if there is not None and there.chi_square < now.chi_square:
            return there
        step = step / 2
    return None


def _moved(now: SolidAdjustment, step: np.ndarray) -> SolidAdjustment | None:
    cameras = [camera.moved(step[now.columns_of(k)]) for k, camera in enumerate(now.cameras)]
    e = now.e + step[: len(now.e)]
    xyz = now.solid.moved_mm(e)[: now.solid.count]
    seen = all(camera.in_front(xyz) for camera in cameras)
    return _linearised(now.solid, now.images, cameras, e) if seen else None


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
        at = slice(balls + 3 * k, balls + 3 * k + 3)
        residual[at], design[at, own : own + PARAMETERS] = prior_rows(camera, image.prior)
    known = balls + 3 * len(images)
    residual[known:] = -e
    design[known:, : len(e)] = np.eye(len(e))
    return SolidAdjustment(solid, tuple(images), tuple(cameras), e, residual, design)


def prior_rows(camera: PanelCamera, prior: PanelPrior) -> tuple[np.ndarray, np.ndarray]:
    """Return the whitened residuals (3,) of a camera's prior, and their design (3, 9)."""
    sd = np.array([prior.focal_share, prior.centre_sd_px, prior.centre_sd_px])
    design = np.zeros((3, PARAMETERS))
    design[range(3), (FOCAL, *range(CENTRE.start, CENTRE.stop))] = 1.0 / sd
    off = np.append(-np.log(camera.focal_px / prior.focal_px), prior.centre_px - camera.centre_px)
    return off / sd, design


# S.d. of what is known of a panel: the stated source-detector distance changes by 6 to 8 mm over the orbit and
# the piercing point wanders by up to 16 mm where the C-arm flexes (physics.md, C-arm).
DISTANCE_SD_MM = 10.0
CENTRE_SD_MM = 5.0
# Of a panel that states nothing [ours]: image widths between 1/8 and 1/2 of the focal length, about this mean, which
# includes panels of 20 to 43 cm, 0.8 to 1.6 m away.
FOCAL_WIDTHS, FOCAL_SHARE = 4.0, 0.5
CENTRE_SHARE = CENTRE_SD_MM / 200.0  # of the image's width, for the smallest panels of C-arms
# Difference of chi-square between an image and its mirror image that decides: odds of e^12.5 to 1 [calc].
MIRROR_EVIDENCE = 25.0
# Of a plate on the detector: the middle of the beam is this far from its own, per axis: that of a panel, and 3 mm and
# 0.3° by which it is put on askew [ours]. A C-arm that states no distance has 0.9 to 1.2 m.
PLATE_CENTRE_SD_MM = CENTRE_SD_MM + 3.0
USUAL_DISTANCE_MM, USUAL_SHARE = 1000.0, 0.1
# Of the solid's balls about their best plane, rms over their rms distance from the middle [ours]: a flatter solid does
# not determine the focal length.
MIN_DEPTH = 0.1


def solid_of(frame: Frame) -> SolidBalls:
    """Return the balls of a frame with a solid. Raises CalibrationRefusedError for a solid that is nearly flat."""
    assert frame.solid is not None  # noqa: S101 - checked by the caller
    xyz = frame.solid.xyz_mm
    spread = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if spread[2] < MIN_DEPTH * np.linalg.norm(spread):
        raise CalibrationRefusedError(
            f"the balls of frame {frame.name} lie nearly in one plane, which leaves the distance of the X-ray source "
            "open; use a solid whose balls fill a volume"
        )
    radius = np.array([f.diameter_mm for f in frame.fiducials]) / 2
    return SolidBalls(frame.xyz_mm, radius, frame.error_factor, len(xyz))


def image_of(seen: Observations, frame: Frame, solid: SolidBalls, c_arm: CArm | None) -> SolidImage:
    """Return the balls of an image and what is known of its camera.

    Raises ObservationsError, CalibrationRefusedError.
    """
    rows = rows_of(seen, frame)
    of_solid = int((rows < solid.count).sum())
    if of_solid < MIN_BALLS:
        raise CalibrationRefusedError(
            f"view {seen.view} shows {of_solid} balls of the solid; {MIN_BALLS} are needed, 9 or more are good: bring "
            "the whole solid into the field"
        )
    if frame.detector is not None:
        return _on_plate(seen, rows, solid, frame.detector.plane, c_arm)
    if seen.image_shape is None:
        raise CalibrationRefusedError(
            f"the image size of view {seen.view} is not known, and with it where its principal point may be; give "
            "image_shape"
        )
    return SolidImage(seen.uv_px, noise_px2(seen), rows, _prior(seen.image_shape, c_arm))


def _on_plate(
    seen: Observations, rows: np.ndarray, solid: SolidBalls, plane: Plane, c_arm: CArm | None
) -> DetectorPlateImage:
    """Return the balls of an intensifier's image with a plate of a plane, in its own coordinates, on the detector.

    Raises CalibrationRefusedError.
    """
    on, noise = rows >= solid.count, noise_px2(seen)
    if on.sum() < MIN_PLATE_BALLS:
        raise CalibrationRefusedError(
            f"view {seen.view} shows {on.sum()} balls of the plate on the detector; {MIN_PLATE_BALLS} are needed, all "
            "over the image: put the plate in front of the detector, and open the collimator"
        )
    uv, xy = seen.uv_px[on], plane.to_plane(solid.xyz_mm[rows[on]])
    refuse_collinear(uv, f"in the image, the {on.sum()} balls seen of the plate on the detector")
    unit, radius_mm = Affine.fit(uv, xy)
    ball_px2 = solid.error_mm**2 / (radius_mm**2 * abs(np.linalg.det(unit.matrix)))
    start = FittedSmoothMap.fit(uv, xy, float(np.sqrt(np.trace(noise[on].mean(axis=0)) / 2 + ball_px2)))
    distance, share = USUAL_DISTANCE_MM, USUAL_SHARE
    if c_arm is not None:
        distance, share = c_arm.source_detector_mm, DISTANCE_SD_MM / c_arm.source_detector_mm
    middle = np.zeros(3)  # of the detector's input plane
    x, y = plane.to_plane(middle).tolist()
    prior = PanelPrior(distance + float(plane.height_mm(middle)), share, (x, y), PLATE_CENTRE_SD_MM)
    return DetectorPlateImage(seen.uv_px, noise, rows, prior, solid.count, plane, start)


def _prior(shape: tuple[int, int], c_arm: CArm | None) -> PanelPrior:
    height, width = shape
    centre = (width - 1) / 2, (height - 1) / 2
    pixel_mm = None if c_arm is None else c_arm.pixel_mm
    if c_arm is None or pixel_mm is None:
        return PanelPrior(FOCAL_WIDTHS * max(shape), FOCAL_SHARE, centre, CENTRE_SHARE * max(shape))
    distance = c_arm.source_detector_mm
    return PanelPrior(distance / pixel_mm, DISTANCE_SD_MM / distance, centre, CENTRE_SD_MM / pixel_mm)


def first_camera(solid: SolidBalls, seen: SolidImage, view: str) -> PanelCamera:
    """Return an approximate camera, mirrored where the image shows the solid as its mirror image.

    Only perspective tells: without it a mirrored image is the solid seen from the other side. On a plate, whose z
    points towards the source, the camera is always mirrored. Raises CalibrationRefusedError.
    """
    image = seen.undistorted()
    (plain, plain_chi2), (mirrored, mirrored_chi2) = (
        best_camera(solid, image, mirrored=handedness) for handedness in (False, True)
    )
    evidence = mirrored_chi2 - plain_chi2  # for the one that is not mirrored
    if isinstance(seen, DetectorPlateImage):
        if evidence > MIRROR_EVIDENCE:
            raise CalibrationRefusedError(
                f"view {view} shows the solid as its mirror image where the plate's z points towards the X-ray source: "
                "put the plate on the right way round, or correct the file of the one that is mirrored"
            )
        return mirrored
    if not abs(evidence) >= MIRROR_EVIDENCE:  # nor if both diverge
        raise CalibrationRefusedError(
            f"view {view} does not tell from which side it shows the solid: its mirror image fits as well; bring more "
            "balls into the field, or use a larger solid"
        )
    return plain if evidence > 0 else mirrored


def best_camera(solid: SolidBalls, image: SolidImage, *, mirrored: bool) -> tuple[PanelCamera, float]:
    """Return the camera of one handedness that fits an image best, and its chi-square, infinite if there is none.

    Of the wrong handedness the last steps may gain too little to converge: its chi-square is as good as the least.
    """
    start = PanelCamera.orthographic(image.prior, solid.xyz_mm[image.rows], image.uv_px, mirrored=mirrored)
    with suppress(np.linalg.LinAlgError):
        fit, _ = iterated(solid, [image], [start])
        return fit.cameras[0], fit.chi_square
    return start, np.inf


def rows_of(seen: Observations, frame: Frame) -> np.ndarray:
    """Return (N,): the observed balls' indices among the solid's. Raises ObservationsError."""
    place = {f.id: k for k, f in enumerate(frame.fiducials)}
    if unknown := [i for i in seen.ids if i not in place]:
        raise ObservationsError(
            f"frame {frame.name!r} has no fiducial {', '.join(map(repr, unknown[:5]))}; check that the observations "
            "belong to this frame"
        )
    return np.array([place[i] for i in seen.ids])


def noise_px2(seen: Observations) -> np.ndarray:
    """Return (N, 2, 2), px²: the stated covariances, or those of careful clicks."""
    if seen.covariance_px2 is not None:
        return seen.covariance_px2
    return np.broadcast_to(UNKNOWN_NOISE_PX**2 * np.eye(2), (len(seen), 2, 2))
