"""Calibration of all views of a solid together: flat panels, whose images share the errors of the solid's balls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

import numpy as np

from sightline.calibration.bead_view import SOLID, BeadView, CalibrationInputs
from sightline.calibration.checks import (
    leave_one_out_check,
    tolerance_checks,
    wrong_beads_check,
)
from sightline.calibration.focal_length import CArm
from sightline.calibration.hull import Hull
from sightline.calibration.outliers import FALSE_ALARM, MAX_WRONG_SHARE
from sightline.calibration.panel import PanelCamera
from sightline.calibration.residuals import Residuals
from sightline.calibration.solid import MIN_BALLS, PanelPrior, SolidAdjustment, SolidBalls, SolidImage, adjust, descend
from sightline.calibration.solid_checks import adjustment_check, checks_of_image
from sightline.calibration.view import CalibratedView
from sightline.calibration.well_conditioned import well_conditioned
from sightline.checks import Check
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError, UnusableInputError
from sightline.fitting.robust import variance_ratio
from sightline.frame import Frame
from sightline.geometry.planes import Plane

# S.d. of what is known of a panel [ours]: the stated source-detector distance changes by 6 to 8 mm over the orbit and
# the piercing point wanders by up to 16 mm where the C-arm flexes (physics.md, C-arm).
DISTANCE_SD_MM = 10.0
CENTRE_SD_MM = 5.0
# Of a panel that states nothing [ours]: image widths between 1/8 and 1/2 of the focal length, about this mean.
FOCAL_WIDTHS, FOCAL_SHARE = 4.0, 0.5
CENTRE_SHARE = CENTRE_SD_MM / 200.0  # of the image's width, for the smallest panels of C-arms
UNKNOWN_NOISE_PX = 0.5  # where none is stated: a careful click (physics.md, Picks)
# Difference of chi-square between an image and its mirror image that decides [ours]: odds of e^12 to 1.
MIRROR_EVIDENCE = 25.0
FIRST_STEPS = 12  # [ours] four suffice; of the wrong handedness none do
MIN_DEPTH = 0.1  # of the solid's balls about their best plane, rms over their rms distance from the middle [ours]


def calibrate_together(
    observations: Sequence[Observations],
    frame: Frame | str | Path,
    c_arms: Sequence[CArm | None] | None = None,
) -> tuple[BeadView, ...]:
    """Return the calibrated views of images that show one solid of balls at rest, in a single adjustment.

    `observations`: one image or more, each of another view and with its size. `c_arms`: the known dimensions of the
    C-arm for each image. The images must come from flat panels; a distorted one fails its checks. Balls that contradict
    the others are left out and named. Raises ObservationsError, FrameError, CalibrationRefusedError.
    """
    frame = Frame.of(frame)
    if frame.solid is None:
        raise CalibrationRefusedError(f"frame {frame.name} has plates: calibrate each of its images by itself")
    if len({one.view for one in observations}) < len(observations):
        raise ObservationsError("two images are of the same view; give each image a name of its own")
    known = c_arms or [None] * len(observations)
    solid = _solid_of(frame)
    images = [_image_of(one, frame, c_arm) for one, c_arm in zip(observations, known, strict=True)]
    with well_conditioned():
        cameras = [_first_camera(solid, image, one.view) for image, one in zip(images, observations, strict=True)]
        fit, left = _robustly(solid, images, cameras, observations)
    adjustment = sha256(b"".join(one.view.encode() + one.uv_px.tobytes() for one in observations)).hexdigest()[:16]
    checks = (adjustment_check(fit), *tolerance_checks(frame))
    return tuple(
        _view(_InOne(fit, k, adjustment), one, frame, c_arm, (left[k], checks))
        for k, (one, c_arm) in enumerate(zip(observations, known, strict=True))
    )


def adjusted_together(views: Sequence[CalibratedView]) -> tuple[CalibratedView, ...]:
    """Return the views of one solid, calibrated image by image, adjusted together; other views as they are.

    They keep the checks of their images and what a person said of the display. Raises CalibrationRefusedError.
    """
    own = [one for one in views if isinstance(one, BeadView) and one.method == SOLID and one.inputs is not None]
    apart = len({one.adjustment for one in own}) == len({one.name for one in own}) == len(views) > 1
    return _adjusted_together(*own) if apart and len({one.frame_key for one in own}) == 1 else tuple(views)


@lru_cache(maxsize=8)  # a point that is dragged is planned again and again on the same views
def _adjusted_together(*views: BeadView) -> tuple[BeadView, ...]:
    inputs = [one.inputs for one in views if one.inputs is not None]
    made = calibrate_together([one.observations for one in inputs], inputs[0].frame, [one.c_arm for one in views])
    return tuple(_with_checks_of(new, old) for new, old in zip(made, views, strict=True))


def _with_checks_of(new: BeadView, old: BeadView) -> BeadView:
    known = {check.name for check in new.checks}
    kept = [check for check in old.checks if check.name not in known]
    return replace(new, checks=(*new.checks, *kept), mirrored_display=old.mirrored_display)


def adjustment_of(view: BeadView) -> SolidAdjustment:
    """Return the adjustment that a view of `calibrate_together` comes from. Raises UnusableInputError for others."""
    if not isinstance(view.posterior, _InOne):
        raise UnusableInputError(f"view {view.name} was not calibrated from a solid")
    return view.posterior.fit


@dataclass(frozen=True, eq=False)
class SolidErrors:
    """The errors of focal point and lines of sight by source, as responses to errors of unit variance."""

    responses: dict[str, np.ndarray]

    def by_source(self) -> dict[str, np.ndarray]:
        """Return the covariances for each of `view.SOURCES`."""
        size = len(self.responses["frame"])
        return {"map": np.zeros((size, size)), **{source: g @ g.T for source, g in self.responses.items()}}

    def shared(self) -> dict[str, np.ndarray]:
        """Return `LinesOfSight.shared`: the views of one adjustment share all errors."""
        return self.responses


@dataclass(frozen=True, eq=False)
class _InOne:
    """One image of an adjustment, as the `Posterior` of its view. `adjustment`: `LinesOfSight.adjustment`."""

    fit: SolidAdjustment
    image: int
    adjustment: str

    def line_errors(self, uv_px: np.ndarray) -> SolidErrors:
        """Return the errors of focal point and lines of sight of pixels (N, 2)."""
        return SolidErrors(self.fit.responses(self.image, self.plane, uv_px))

    @property
    def plane(self) -> Plane:
        """The reference plane: through the solid's middle, across the camera's axis."""
        return Plane.across(self.fit.cameras[self.image].rotation[2], self.fit.solid.xyz_mm.mean(axis=0))


def _solid_of(frame: Frame) -> SolidBalls:
    assert frame.solid is not None  # noqa: S101 - checked by the caller
    xyz = frame.solid.xyz_mm
    spread = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if spread[2] < MIN_DEPTH * np.linalg.norm(spread):
        raise CalibrationRefusedError(
            f"the balls of frame {frame.name} lie nearly in one plane, which leaves the distance of the X-ray source "
            "open; use a solid whose balls fill a volume"
        )
    radius = np.array([f.diameter_mm for f in frame.solid.fiducials]) / 2
    return SolidBalls(xyz, radius, frame.error_factor)


def _image_of(seen: Observations, frame: Frame, c_arm: CArm | None) -> SolidImage:
    """Return the balls of an image and what is known of its panel.

    Raises ObservationsError, CalibrationRefusedError.
    """
    rows = _rows_of(seen, frame)
    if len(seen) < MIN_BALLS:
        raise CalibrationRefusedError(
            f"view {seen.view} shows {len(seen)} balls of the solid; {MIN_BALLS} are needed, 9 or more are good: bring "
            "the whole solid into the field"
        )
    if seen.image_shape is None:
        raise CalibrationRefusedError(
            f"the image size of view {seen.view} is not known, and with it where its principal point may be; give "
            "image_shape"
        )
    return SolidImage(seen.uv_px, _noise_px2(seen), rows, _prior(seen.image_shape, c_arm))


def _prior(shape: tuple[int, int], c_arm: CArm | None) -> PanelPrior:
    height, width = shape
    centre = (width - 1) / 2, (height - 1) / 2
    pixel_mm = None if c_arm is None else c_arm.pixel_mm
    if c_arm is None or pixel_mm is None:
        return PanelPrior(FOCAL_WIDTHS * max(shape), FOCAL_SHARE, centre, CENTRE_SHARE * max(shape))
    distance = c_arm.source_detector_mm
    return PanelPrior(distance / pixel_mm, DISTANCE_SD_MM / distance, centre, CENTRE_SD_MM / pixel_mm)


def _first_camera(solid: SolidBalls, image: SolidImage, view: str) -> PanelCamera:
    """Return an approximate camera, mirrored where the image shows the solid as its mirror image.

    Only perspective tells: without it a mirrored image is the solid seen from the other side. The balls' errors count
    as noise here. Raises CalibrationRefusedError.
    """
    rigid = replace(solid, factor=np.zeros((solid.xyz_mm.size, 0)))
    prior = image.prior
    starts = [
        PanelCamera.of_affine(
            image.uv_px, solid.xyz_mm[image.rows], prior.focal_px, np.array(prior.centre_px), mirrored=mirrored
        )
        for mirrored in (False, True)
    ]
    errors_px = starts[0].focal_px / np.linalg.norm(starts[0].focal_point_mm) * solid.error_mm
    noisy = replace(image, covariance_px2=image.covariance_px2 + errors_px**2 * np.eye(2))
    found = [descend(rigid, [noisy], [start], FIRST_STEPS)[0] for start in starts]
    found.sort(key=lambda fit: fit.chi_square)
    if found[1].chi_square - found[0].chi_square < MIRROR_EVIDENCE:
        raise CalibrationRefusedError(
            f"view {view} does not tell from which side it shows the solid: its mirror image fits as well; bring more "
            "balls into the field, or use a larger solid"
        )
    return found[0].cameras[0]


def _robustly(
    solid: SolidBalls, images: list[SolidImage], cameras: list[PanelCamera], seen: Sequence[Observations]
) -> tuple[SolidAdjustment, list[list[str]]]:
    """Return the adjustment without outlying balls, and their names by image. Raises CalibrationRefusedError."""
    left: list[list[str]] = [[] for _ in images]
    names = [list(one.ids) for one in seen]
    total = sum(len(one.rows) for one in images)
    limit = max(1, int(MAX_WRONG_SHARE * total))
    while True:
        fit = adjust(solid, images, cameras)
        squares = [fit.left_out(k)[1] for k in range(len(images))]
        common = max(1.0, variance_ratio(np.concatenate(squares)))
        k = int(np.argmax([square.max() for square in squares]))
        worst = int(np.argmax(squares[k]))
        if squares[k][worst] <= -2 * np.log(FALSE_ALARM / total) * common:
            return fit, left
        left[k].append(names[k].pop(worst))
        images = [one.without(worst) if n == k else one for n, one in enumerate(images)]
        if sum(map(len, left)) > limit or len(images[k].rows) < MIN_BALLS:
            wrong = ", ".join(f"{ball} in {one.view}" for one, balls in zip(seen, left, strict=True) for ball in balls)
            raise CalibrationRefusedError(
                f"more than {limit} balls contradict the others ({wrong}); check that the frame file is that of the "
                "solid in the images, that it did not move between them, and that it is undamaged"
            )


def _view(
    own: _InOne, seen: Observations, frame: Frame, c_arm: CArm | None, told: tuple[list[str], tuple[Check, ...]]
) -> BeadView:
    """Return the view of one image. `told`: ids of the balls left out of it, and the checks of the adjustment."""
    fit, camera, plane = own.fit, own.fit.cameras[own.image], own.plane
    assert seen.image_shape is not None  # noqa: S101 - checked with the image
    height, width = seen.image_shape
    corners = np.array([[0.0, 0.0], [width - 1, 0.0], [width - 1, height - 1], [0.0, height - 1]])
    residuals = _residuals(own, seen, frame, told[0])
    checks = [*checks_of_image(fit, own.image, c_arm), leave_one_out_check(residuals)]
    checks += [wrong_beads_check(residuals)] if residuals.left_out else []
    strays = None if seen.rejected is None else np.array([one.uv_px for one in seen.rejected]).reshape(-1, 2)
    return BeadView(
        name=seen.view,
        method=SOLID,
        plane=plane,
        plane_map=camera.plane_map(plane),
        focal_point_mm=camera.focal_point_mm,
        residuals=residuals,
        mirrored=camera.mirrored,
        hull=Hull.of(corners),
        checks=(*checks, *told[1]),
        frame_key=frame.fingerprint,
        fiducials=frame.fiducials,
        posterior=own,
        image_shape=seen.image_shape,
        rejected_px=strays,
        c_arm=c_arm,
        adjustment=own.adjustment,
        inputs=CalibrationInputs(seen, frame),
    )


def _residuals(own: _InOne, seen: Observations, frame: Frame, left: list[str]) -> Residuals:
    """Return the residuals of an image's balls on the reference plane; those of the adjusted solid."""
    fit, camera, plane = own.fit, own.fit.cameras[own.image], own.plane
    rows = _rows_of(seen, frame)
    used = np.array([i not in left for i in seen.ids])
    off_px, sigma = fit.prediction(own.image, seen.uv_px, rows, _noise_px2(seen))
    to_mm = camera.plane_map(plane).jacobian(seen.uv_px)
    residual = np.einsum("nab,nb->na", to_mm, off_px)
    alone_px, square = fit.left_out(own.image)
    loo = residual.copy()
    loo[used], sigma[used] = np.einsum("nab,nb->na", to_mm[used], alone_px), np.sqrt(square)
    return Residuals(seen.ids, seen.uv_px, residual, loo, np.ones(len(rows), dtype=bool), sigma, used)


def _rows_of(seen: Observations, frame: Frame) -> np.ndarray:
    """Return (N,): the observed balls' indices among the solid's. Raises ObservationsError."""
    place = {f.id: k for k, f in enumerate(frame.fiducials)}
    if unknown := [i for i in seen.ids if i not in place]:
        raise ObservationsError(
            f"frame {frame.name!r} has no fiducial {', '.join(map(repr, unknown[:5]))}; check that the observations "
            "belong to this frame"
        )
    return np.array([place[i] for i in seen.ids])


def _noise_px2(seen: Observations) -> np.ndarray:
    """Return (N, 2, 2), px²: the stated covariances, or those of careful clicks."""
    if seen.covariance_px2 is not None:
        return seen.covariance_px2
    return np.broadcast_to(UNKNOWN_NOISE_PX**2 * np.eye(2), (len(seen), 2, 2))
